//! A running stream: the driver's buffers, mapped, and whose each of them is.
//!
//! Input: an open device whose format is set. Output: filled buffers one by one, their bytes where the driver wrote them, no copy. Calls: REQBUFS,
//! QUERYBUF + mmap + QBUF for each buffer, STREAMON; then poll, DQBUF, QBUF for each frame; at the end STREAMOFF, munmap,
//! REQBUFS(0). After a poll that timed out no buffer is touched, and a buffer that the driver owns is neither read nor given back again.

use super::capture::{BufferQueue, Filled, QueueError};
use super::device::{CallError, Device, in_call};
use std::io;
use std::os::fd::AsRawFd;
use std::ptr::NonNull;
use std::time::{Duration, Instant};
use v4l::v4l_sys as sys;
use v4l::v4l2::vidioc;

const BUF_FLAG_ERROR: u32 = 0x40;
const BUF_FLAG_TIMESTAMP_MASK: u32 = 0xe000;
const BUF_FLAG_TIMESTAMP_MONOTONIC: u32 = 0x2000;

/// Memory of one of the driver's buffers.
#[derive(Debug)]
struct Mapping {
    start: NonNull<u8>,
    length: usize,
    /// The driver has given it to us.
    ours: bool,
}

// SAFETY: the memory belongs to the mapping alone and stays where it is; nothing about it is bound to a thread.
unsafe impl Send for Mapping {}

impl Mapping {
    fn new(device: &Device, buffer: &sys::v4l2_buffer) -> io::Result<Self> {
        let length = buffer.length as usize;
        if length == 0 {
            return Err(io::Error::other("the driver made a buffer of 0 bytes"));
        }
        // SAFETY: QUERYBUF on a buffer of type MMAP writes the offset.
        let offset = unsafe { buffer.m.offset };
        // SAFETY: a new mapping at an address of the kernel's choice touches no existing memory; descriptor, offset and length
        // are those that the driver gave for this buffer.
        let start = unsafe {
            libc::mmap(
                std::ptr::null_mut(),
                length,
                libc::PROT_READ | libc::PROT_WRITE,
                libc::MAP_SHARED,
                device.file.as_raw_fd(),
                offset as libc::off_t,
            )
        };
        if start == libc::MAP_FAILED {
            return Err(io::Error::last_os_error());
        }
        let start = NonNull::new(start.cast()).ok_or_else(|| io::Error::other("mapped at address 0"))?;
        Ok(Self { start, length, ours: false })
    }
}

impl Drop for Mapping {
    fn drop(&mut self) {
        // SAFETY: exactly the range that mmap gave, unmapped once; every slice of it borrowed from `self`.
        unsafe { libc::munmap(self.start.as_ptr().cast(), self.length) };
    }
}

/// A running stream.
#[derive(Debug)]
pub struct MmapQueue {
    mappings: Vec<Mapping>,
    device: Device,
}

impl MmapQueue {
    /// Makes and maps the buffers, hands them to the driver and starts the stream.
    pub fn start(device: Device, buffers: u32) -> Result<Self, CallError> {
        let granted = in_call("REQBUFS", device.request_buffers(buffers))?;
        if granted < 2 {
            let error = io::Error::other(format!("the driver has {granted} buffers, 2 are needed"));
            return Err(CallError { call: "REQBUFS", error });
        }
        // From here on a failure drops the queue, which gives all back.
        let mut queue = Self { mappings: Vec::new(), device };
        for index in 0..granted {
            let buffer = in_call("QUERYBUF", queue.device.buffer(vidioc::VIDIOC_QUERYBUF, index))?;
            queue.mappings.push(in_call("mmap", Mapping::new(&queue.device, &buffer))?);
            in_call("QBUF", queue.device.buffer(vidioc::VIDIOC_QBUF, index))?;
        }
        in_call("STREAMON", queue.device.stream(vidioc::VIDIOC_STREAMON))?;
        Ok(queue)
    }

    /// The device, for its controls.
    pub fn device(&self) -> &Device {
        &self.device
    }

    /// Events on the device; 0 after `timeout`.
    fn poll(&self, timeout: Duration) -> io::Result<libc::c_short> {
        let mut fd = libc::pollfd { fd: self.device.file.as_raw_fd(), events: libc::POLLIN, revents: 0 };
        // Rounded up: a last fraction of a millisecond must not become a busy loop.
        let ms = timeout.as_nanos().div_ceil(1_000_000).min(i32::MAX as u128) as libc::c_int;
        // SAFETY: one valid pollfd, and the count says one.
        match unsafe { libc::poll(&mut fd, 1, ms) } {
            -1 => Err(io::Error::last_os_error()),
            _ => Ok(fd.revents),
        }
    }
}

impl BufferQueue for MmapQueue {
    fn dequeue(&mut self, timeout: Duration) -> Result<Option<Filled>, QueueError> {
        let deadline = Instant::now().checked_add(timeout);
        loop {
            // A timeout beyond what the clock can count is one that never comes.
            let left = deadline.map_or(timeout, |d| d.saturating_duration_since(Instant::now()));
            let events = match self.poll(left) {
                Ok(0) => return Ok(None),
                Ok(events) => events,
                Err(e) if e.kind() == io::ErrorKind::Interrupted => {
                    if left.is_zero() {
                        return Ok(None);
                    }
                    continue;
                }
                Err(e) => return Err(QueueError::Gone(format!("poll: {e}"))),
            };
            match self.device.buffer(vidioc::VIDIOC_DQBUF, 0) {
                Ok(buffer) => {
                    let Some(mapping) = self.mappings.get_mut(buffer.index as usize) else {
                        return Err(QueueError::Gone(format!(
                            "the driver gave buffer {}, which is none",
                            buffer.index
                        )));
                    };
                    mapping.ours = true;
                    return Ok(Some(filled(&buffer)));
                }
                Err(e) => match e.raw_os_error() {
                    // Nothing there yet; with an error event there never will be.
                    Some(libc::EAGAIN) if events & (libc::POLLERR | libc::POLLHUP | libc::POLLNVAL) == 0 => {
                        if left.is_zero() {
                            return Ok(None);
                        }
                    }
                    Some(libc::ENODEV) => return Err(QueueError::Gone("it was unplugged".into())),
                    // The driver has broken the stream off: no later call on it will do better.
                    Some(libc::EIO) if events & libc::POLLERR != 0 => {
                        return Err(QueueError::Gone("the driver broke the stream off".into()));
                    }
                    Some(libc::EIO) => return Err(QueueError::Trouble(format!("DQBUF: {e}"))),
                    _ => return Err(QueueError::Gone(format!("DQBUF: {e}"))),
                },
            }
        }
    }

    fn bytes(&self, index: u32) -> &[u8] {
        match self.mappings.get(index as usize) {
            // SAFETY: mapped, readable and of this length as long as the mapping lives, which `self` outlives the slice for; the
            // driver writes into a buffer only while it is queued, and `ours` says that it is not.
            Some(m) if m.ours => unsafe { std::slice::from_raw_parts(m.start.as_ptr(), m.length) },
            _ => &[],
        }
    }

    fn requeue(&mut self, index: u32) -> Result<(), QueueError> {
        let Some(mapping) = self.mappings.get_mut(index as usize).filter(|m| m.ours) else {
            return Err(QueueError::Gone(format!("buffer {index} is not ours to give back")));
        };
        mapping.ours = false;
        self.device.buffer(vidioc::VIDIOC_QBUF, index).map(drop).map_err(|e| QueueError::Gone(format!("QBUF: {e}")))
    }
}

impl Drop for MmapQueue {
    fn drop(&mut self) {
        // An unplugged camera answers with errors, and that is all right. A driver refuses to free mapped buffers.
        let _ = self.device.stream(vidioc::VIDIOC_STREAMOFF);
        self.mappings.clear();
        let _ = self.device.request_buffers(0);
    }
}

fn filled(buffer: &sys::v4l2_buffer) -> Filled {
    let monotonic = buffer.flags & BUF_FLAG_TIMESTAMP_MASK == BUF_FLAG_TIMESTAMP_MONOTONIC;
    let seconds: i64 = buffer.timestamp.tv_sec;
    let micros: i64 = buffer.timestamp.tv_usec;
    Filled {
        index: buffer.index,
        bytes_used: buffer.bytesused as usize,
        sequence: buffer.sequence,
        timestamp_ns: monotonic
            .then(|| seconds.saturating_mul(1_000_000_000).saturating_add(micros.saturating_mul(1_000))),
        corrupt: buffer.flags & BUF_FLAG_ERROR != 0,
    }
}
