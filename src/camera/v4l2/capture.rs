//! What a driver's buffer means: a frame, a broken one, a time-out, or that the camera is gone.
//!
//! Input: a [`BufferQueue`], which is the kernel's in [`super::device`] and a fake one in the tests. Output: frames in slots.
//!
//! - Every buffer that was taken is given back, whatever was in it.
//! - A buffer that the driver flags as broken, that is empty, or shorter than its picture is skipped with the reason.
//! - Frame numbers follow the driver's, so that what it lost shows as a gap; a driver that does not count is counted for.
//! - Timestamps count CLOCK_MONOTONIC. A driver's that is not (or that lies more than a second ahead or, unless it goes on from one that was,
//!   a minute back) is replaced by the moment of arrival; a small lead is kept, differences are signed. One that does not advance is skipped.
//! - Passing errors are skipped frames; 30 in a row, without a frame between them, mean that the camera is gone.
//!
//! Cost: the copy. Not here: system calls.

use super::super::{Grab, SourceError};
use crate::frame::{PixelFormat, RawFrame, monotonic_ns};
use crate::image::decode::copy_luma;
use std::time::Duration;

/// So many errors in a row are no passing trouble.
const MAX_TROUBLE: u32 = 30;
/// A jump of the driver's frame number beyond this is a restart and not a loss.
const MAX_GAP: u32 = 10_000;
/// A timestamp this far ahead of now is not from our clock. (35 ms ahead have been seen from one that was.)
const MAX_AHEAD_NS: i64 = 1_000_000_000;
/// Nor is one this far back, as a first one. (A process that was stopped finds old frames in its buffers, and rightly old.)
const MAX_BEHIND_NS: i64 = 60_000_000_000;

/// A buffer that the driver has filled.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Filled {
    pub index: u32,
    pub bytes_used: usize,
    /// The driver's frame number, which wraps.
    pub sequence: u32,
    /// `None` when the driver's clock is not CLOCK_MONOTONIC.
    pub timestamp_ns: Option<i64>,
    /// The driver knows that the data is broken.
    pub corrupt: bool,
}

/// Why a queue gave nothing.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum QueueError {
    /// Unplugged, or so broken that only opening it again can help.
    Gone(String),
    /// May pass.
    Trouble(String),
}

/// The seam between the logic here and the kernel: buffers that go back and forth.
pub trait BufferQueue: Send {
    /// The next filled buffer, which is the caller's until [`BufferQueue::requeue`]; `None` after `timeout`.
    fn dequeue(&mut self, timeout: Duration) -> Result<Option<Filled>, QueueError>;
    /// The whole memory of a buffer that was dequeued; empty for any other.
    fn bytes(&self, index: u32) -> &[u8];
    /// Gives a buffer back.
    fn requeue(&mut self, index: u32) -> Result<(), QueueError>;
}

/// How the picture lies in a buffer, as granted by the driver.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Layout {
    /// `Grey`, `Yuyv` or `Jpeg`.
    pub format: PixelFormat,
    /// Pixels.
    pub width: u32,
    pub height: u32,
    /// Bytes a row; unused for `Jpeg`.
    pub stride: u32,
}

/// A stream of buffers as a source of frames.
pub struct Capture<Q> {
    queue: Q,
    layout: Layout,
    /// For messages.
    path: String,
    /// Why there will be no more frames.
    gone: Option<String>,
    trouble: u32,
    /// Number of the last frame, and the driver's for it.
    last: Option<(u64, u32)>,
    last_timestamp_ns: Option<i64>,
    /// The driver's last timestamp, if it was of our clock.
    believed_ns: Option<i64>,
}

impl<Q: BufferQueue> Capture<Q> {
    pub fn new(queue: Q, layout: Layout, path: String) -> Self {
        Self { queue, layout, path, gone: None, trouble: 0, last: None, last_timestamp_ns: None, believed_ns: None }
    }

    pub fn queue(&self) -> &Q {
        &self.queue
    }

    /// See [`super::FrameSource::grab`].
    pub fn grab(&mut self, slot: &mut RawFrame, timeout: Duration) -> Result<Grab, SourceError> {
        if let Some(reason) = &self.gone {
            return Err(SourceError::Gone { path: self.path.clone(), reason: reason.clone() });
        }
        let filled = match self.queue.dequeue(timeout) {
            Ok(None) => return Ok(Grab::TimedOut),
            Ok(Some(filled)) => filled,
            Err(QueueError::Trouble(reason)) => {
                self.trouble += 1;
                if self.trouble < MAX_TROUBLE {
                    return Ok(Grab::Skipped { reason });
                }
                return self.end(format!("{MAX_TROUBLE} errors in a row, the last: {reason}"));
            }
            Err(QueueError::Gone(reason)) => return self.end(reason),
        };
        let arrival_ns = monotonic_ns();
        let sequence = self.count(filled.sequence);
        let taken = self.take(&filled, arrival_ns, sequence, slot);
        match self.queue.requeue(filled.index) {
            Ok(()) => {}
            // The frame in the slot is whole all the same; the next call says what happened.
            Err(QueueError::Gone(reason) | QueueError::Trouble(reason)) => self.gone = Some(reason),
        }
        match taken {
            Ok(()) => {
                self.trouble = 0;
                Ok(Grab::Frame)
            }
            Err(reason) => Ok(Grab::Skipped { reason: format!("frame {sequence}: {reason}") }),
        }
    }

    fn end(&mut self, reason: String) -> Result<Grab, SourceError> {
        self.gone = Some(reason.clone());
        Err(SourceError::Gone { path: self.path.clone(), reason })
    }

    /// Our number of a frame from the driver's: 0 for the first, and what the driver lost counted.
    fn count(&mut self, driver: u32) -> u64 {
        let number = match self.last {
            None => 0,
            Some((number, before)) => match driver.wrapping_sub(before) {
                step @ 1..=MAX_GAP => number + u64::from(step),
                _ => number + 1,
            },
        };
        self.last = Some((number, driver));
        number
    }

    /// Copies a buffer into the slot.
    fn take(&mut self, filled: &Filled, arrival_ns: i64, sequence: u64, slot: &mut RawFrame) -> Result<(), String> {
        if filled.corrupt {
            return Err("the driver says that its data is broken".into());
        }
        let memory = self.queue.bytes(filled.index);
        let bytes = memory.get(..filled.bytes_used).ok_or_else(|| {
            format!("the driver says {} bytes of a buffer that has {}", filled.bytes_used, memory.len())
        })?;
        if bytes.is_empty() {
            return Err("the buffer is empty".into());
        }
        let believed_ns = believed(filled.timestamp_ns, arrival_ns, self.believed_ns);
        let timestamp_ns = believed_ns.unwrap_or(arrival_ns);
        if self.last_timestamp_ns.is_some_and(|last| timestamp_ns <= last) {
            return Err(format!("timestamp {timestamp_ns} ns does not advance"));
        }
        let Layout { format, width, height, stride } = self.layout;
        match format {
            PixelFormat::Jpeg | PixelFormat::Png => {
                if !bytes.starts_with(&[0xff, 0xd8]) {
                    return Err(format!("{} bytes that are no JPEG", bytes.len()));
                }
                slot.data.clear();
                slot.data.extend_from_slice(bytes);
                (slot.format, slot.width, slot.height, slot.stride) = (PixelFormat::Jpeg, 0, 0, 0);
            }
            PixelFormat::Grey | PixelFormat::Yuyv => {
                let (w, h, s) = (width as usize, height as usize, stride as usize);
                slot.data.resize(w * h, 0);
                match format {
                    PixelFormat::Yuyv => copy_luma::<2>(bytes, s, w, h, &mut slot.data),
                    _ => copy_luma::<1>(bytes, s, w, h, &mut slot.data),
                }
                .map_err(|reason| format!("{} bytes are too few: {reason}", bytes.len()))?;
                (slot.format, slot.width, slot.height, slot.stride) = (PixelFormat::Grey, width, height, width);
            }
        }
        (self.last_timestamp_ns, self.believed_ns) = (Some(timestamp_ns), believed_ns);
        (slot.sequence, slot.timestamp_ns, slot.arrival_ns) = (sequence, timestamp_ns, arrival_ns);
        Ok(())
    }
}

/// The driver's timestamp if it can be one of our clock. `before`: the one before, if it was.
fn believed(driver_ns: Option<i64>, arrival_ns: i64, before: Option<i64>) -> Option<i64> {
    let behind = |t: i64| arrival_ns.saturating_sub(t);
    let goes_on = |t: i64| behind(t) <= MAX_BEHIND_NS || before.is_some_and(|before| t > before);
    driver_ns.filter(|t| *t > 0 && behind(*t) >= -MAX_AHEAD_NS && goes_on(*t))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_frame_that_waited_for_long_keeps_its_time_if_the_driver_is_known_to_have_our_clock() {
        let (now, late) = (1_000_000_000_000, 2 * MAX_BEHIND_NS);
        assert_eq!(believed(Some(now), now + late, None), None);
        assert_eq!(believed(Some(now), now + late, Some(now - 1)), Some(now));
        assert_eq!(believed(Some(now), now + late, Some(now)), None);
        assert_eq!(believed(Some(now + late), now, Some(now - 1)), None);
    }
}
