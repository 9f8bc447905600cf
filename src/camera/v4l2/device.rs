//! The kernel's side of a camera: ioctls. With the queue of mapped buffers (`queue.rs`) the only `unsafe` of the camera room.
//!
//! The structs and ioctl numbers are crate `v4l`'s; its streams, formats and control lists are not used: its stream gives
//! the driver a buffer twice after a time-out, its format conversion panics on values that it does not know, its lists have no end
//! of their own. Here every list and every retry has a bound.
//!
//! Calls in the order of a stream's life: QUERYCAP, ENUM_FMT / ENUM_FRAMESIZES / ENUM_FRAMEINTERVALS, S_FMT (size and stride are
//! read from its answer), S_PARM (without it some drivers send at 5 Hz); then the queue's.

use super::negotiate::{CameraFormat, Choice, Interval, Offer, Rates, nearest_step};
use std::fs::File;
use std::io;
use std::os::fd::AsRawFd;
use std::os::unix::fs::{FileTypeExt, OpenOptionsExt};
use std::path::Path;
use v4l::v4l_sys as sys;
use v4l::v4l2::vidioc;

const CAPTURE: u32 = 1; // V4L2_BUF_TYPE_VIDEO_CAPTURE
const MMAP: u32 = 1; // V4L2_MEMORY_MMAP
const CAP_VIDEO_CAPTURE: u32 = 0x1;
const CAP_STREAMING: u32 = 0x0400_0000;
const CAP_DEVICE_CAPS: u32 = 0x8000_0000;
const CAP_TIME_PER_FRAME: u32 = 0x1000;
const FIELD_NONE: u32 = 1;
const DISCRETE: u32 = 1; // of sizes and intervals alike
const CONTROL_DISABLED: u32 = 1; // V4L2_CTRL_FLAG_DISABLED

/// Bounds of what a driver may list.
const MAX_FORMATS: u32 = 64;
const MAX_SIZES: u32 = 128;
const MAX_INTERVALS: u32 = 64;
/// A call that was interrupted by a signal is repeated so often.
const MAX_INTERRUPTS: u32 = 100;
/// An open device file.
#[derive(Debug)]
pub struct Device {
    pub(super) file: File,
}

/// What a device says of itself.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Capability {
    pub driver: String,
    pub card: String,
    pub bus: String,
    /// Single-planar capture by streaming.
    pub captures: bool,
}

/// A failed step of starting a stream.
#[derive(Debug, thiserror::Error)]
#[error("{call}: {error}")]
pub struct CallError {
    pub call: &'static str,
    pub error: io::Error,
}

pub(super) fn in_call<T>(call: &'static str, result: io::Result<T>) -> Result<T, CallError> {
    result.map_err(|error| CallError { call, error })
}

/// Values that a control may have.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ControlRange {
    pub low: i32,
    pub high: i32,
    pub step: i32,
    pub default: i32,
}

/// What the driver made of the format that it was asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Granted {
    pub width: u32,
    pub height: u32,
    /// Bytes a row.
    pub stride: u32,
}

impl Device {
    /// Opens a device file for reading and writing; calls on it never block.
    pub fn open(path: &Path) -> io::Result<Self> {
        let metadata = std::fs::metadata(path)?;
        if !metadata.file_type().is_char_device() {
            return Err(io::Error::new(io::ErrorKind::InvalidInput, "is not a device file"));
        }
        let file = File::options().read(true).write(true).custom_flags(libc::O_NONBLOCK).open(path)?;
        Ok(Self { file })
    }

    /// One ioctl, repeated when a signal interrupts it.
    ///
    /// # Safety
    /// `request` must be declared for `T`: the kernel reads and writes exactly one `T`, and puts no pointer of its own in it.
    unsafe fn ioctl<T>(&self, request: vidioc::_IOC_TYPE, argument: &mut T) -> io::Result<()> {
        let mut result = Ok(());
        for _ in 0..MAX_INTERRUPTS {
            // SAFETY: the descriptor is open as long as `self.file` lives; `argument` is a whole, exclusive `T`, which is what
            // `request` takes (the caller's promise).
            result = unsafe { v4l::v4l2::ioctl(self.file.as_raw_fd(), request, std::ptr::from_mut(argument).cast()) };
            match &result {
                Err(e) if e.kind() == io::ErrorKind::Interrupted => {}
                _ => break,
            }
        }
        result
    }

    pub fn capability(&self) -> io::Result<Capability> {
        let mut caps: sys::v4l2_capability = zeroed();
        // SAFETY: QUERYCAP is declared for v4l2_capability.
        unsafe { self.ioctl(vidioc::VIDIOC_QUERYCAP, &mut caps)? };
        // A driver of several nodes says in `device_caps` what this one can do.
        let bits = if caps.capabilities & CAP_DEVICE_CAPS != 0 { caps.device_caps } else { caps.capabilities };
        Ok(Capability {
            driver: text(&caps.driver),
            card: text(&caps.card),
            bus: text(&caps.bus_info),
            captures: bits & CAP_VIDEO_CAPTURE != 0 && bits & CAP_STREAMING != 0,
        })
    }

    /// Four-character codes of what the camera sends.
    fn fourccs(&self) -> Vec<u32> {
        let mut found = Vec::new();
        for index in 0..MAX_FORMATS {
            let mut format: sys::v4l2_fmtdesc = zeroed();
            (format.index, format.type_) = (index, CAPTURE);
            // SAFETY: ENUM_FMT is declared for v4l2_fmtdesc.
            if unsafe { self.ioctl(vidioc::VIDIOC_ENUM_FMT, &mut format) }.is_err() {
                break;
            }
            found.push(format.pixelformat);
        }
        found
    }

    /// The same for a message; the first of many.
    pub fn format_names(&self) -> String {
        const SHOWN: usize = 12;
        let codes = self.fourccs();
        let names: Vec<String> = codes.iter().take(SHOWN).map(|code| text(&code.to_le_bytes())).collect();
        match (names.is_empty(), codes.len() > SHOWN) {
            (true, _) => "nothing".into(),
            (_, true) => format!("{}, ...", names.join(", ")),
            _ => names.join(", "),
        }
    }

    /// Every usable format and size; of sizes that go in steps the one nearest to `width` x `height`.
    pub fn offers(&self, width: u32, height: u32) -> Vec<Offer> {
        let mut offers = Vec::new();
        for format in self.fourccs().into_iter().filter_map(CameraFormat::from_fourcc) {
            for (width, height) in self.sizes(format, width, height) {
                offers.push(Offer { format, width, height, rates: self.rates(format, width, height) });
            }
        }
        offers
    }

    fn sizes(&self, format: CameraFormat, width: u32, height: u32) -> Vec<(u32, u32)> {
        let mut found = Vec::new();
        for index in 0..MAX_SIZES {
            let mut size: sys::v4l2_frmsizeenum = zeroed();
            (size.index, size.pixel_format) = (index, format.fourcc());
            // SAFETY: ENUM_FRAMESIZES is declared for v4l2_frmsizeenum.
            if unsafe { self.ioctl(vidioc::VIDIOC_ENUM_FRAMESIZES, &mut size) }.is_err() {
                break;
            }
            if size.type_ == DISCRETE {
                // SAFETY: the type says which member the kernel wrote; both are plain integers.
                let size = unsafe { size.__bindgen_anon_1.discrete };
                found.push((size.width, size.height));
            } else {
                // SAFETY: as above; a stepwise or continuous range is listed alone.
                let s = unsafe { size.__bindgen_anon_1.stepwise };
                found.push((
                    nearest_step(width, s.min_width, s.max_width, s.step_width),
                    nearest_step(height, s.min_height, s.max_height, s.step_height),
                ));
                break;
            }
        }
        if found.is_empty() {
            // A driver that lists no sizes adjusts what it is asked for.
            found.push((width, height));
        }
        found
    }

    fn rates(&self, format: CameraFormat, width: u32, height: u32) -> Rates {
        let mut found = Vec::new();
        for index in 0..MAX_INTERVALS {
            let mut interval: sys::v4l2_frmivalenum = zeroed();
            (interval.index, interval.pixel_format) = (index, format.fourcc());
            (interval.width, interval.height) = (width, height);
            // SAFETY: ENUM_FRAMEINTERVALS is declared for v4l2_frmivalenum.
            if unsafe { self.ioctl(vidioc::VIDIOC_ENUM_FRAMEINTERVALS, &mut interval) }.is_err() {
                break;
            }
            if interval.type_ == DISCRETE {
                // SAFETY: the type says which member the kernel wrote; both are plain integers.
                found.push(from_fraction(unsafe { interval.__bindgen_anon_1.discrete }));
            } else {
                // SAFETY: as above; a range is listed alone.
                let s = unsafe { interval.__bindgen_anon_1.stepwise };
                return match (from_fraction(s.max).rate_hz(), from_fraction(s.min).rate_hz()) {
                    (Some(slow), Some(fast)) => Rates::Between(slow, fast),
                    _ => Rates::Unknown,
                };
            }
        }
        if found.is_empty() { Rates::Unknown } else { Rates::Listed(found) }
    }

    /// Sets format and size. An answer in another format is an error; another size is not.
    pub fn set_format(&self, choice: &Choice) -> Result<Granted, CallError> {
        let refused = |reason: String| CallError { call: "S_FMT", error: io::Error::other(reason) };
        let mut format: sys::v4l2_format = zeroed();
        format.type_ = CAPTURE;
        let mut wanted: sys::v4l2_pix_format = zeroed();
        (wanted.width, wanted.height) = (choice.width, choice.height);
        (wanted.pixelformat, wanted.field) = (choice.format.fourcc(), FIELD_NONE);
        format.fmt.pix = wanted;
        // SAFETY: S_FMT is declared for v4l2_format.
        in_call("S_FMT", unsafe { self.ioctl(vidioc::VIDIOC_S_FMT, &mut format) })?;
        // SAFETY: for this buffer type the union holds `pix`, plain integers.
        let pix = unsafe { format.fmt.pix };
        if pix.pixelformat != choice.format.fourcc() {
            let got = text(&pix.pixelformat.to_le_bytes());
            return Err(refused(format!("asked for {}, the driver set {got}", choice.format)));
        }
        if pix.field > FIELD_NONE {
            return Err(refused("sends interlaced pictures, which are not handled".into()));
        }
        let row_bytes = pix.width.saturating_mul(choice.format.bytes_per_pixel());
        let stride = if pix.bytesperline == 0 { row_bytes } else { pix.bytesperline };
        Ok(Granted { width: pix.width, height: pix.height, stride })
    }

    /// Asks for the rate and returns what is granted, Hz; `None` if the camera cannot be asked.
    pub fn set_rate(&self, choice: &Choice) -> Option<f64> {
        let mut parameters: sys::v4l2_streamparm = zeroed();
        parameters.type_ = CAPTURE;
        // SAFETY: G_PARM is declared for v4l2_streamparm.
        unsafe { self.ioctl(vidioc::VIDIOC_G_PARM, &mut parameters) }.ok()?;
        // SAFETY: for this buffer type the union holds `capture`, plain integers.
        let mut capture = unsafe { parameters.parm.capture };
        if capture.capability & CAP_TIME_PER_FRAME != 0 {
            capture.timeperframe =
                sys::v4l2_fract { numerator: choice.interval.numerator, denominator: choice.interval.denominator };
            parameters.parm.capture = capture;
            // SAFETY: S_PARM is declared for v4l2_streamparm.
            if unsafe { self.ioctl(vidioc::VIDIOC_S_PARM, &mut parameters) }.is_ok() {
                // SAFETY: as above.
                capture = unsafe { parameters.parm.capture };
            }
        }
        from_fraction(capture.timeperframe).rate_hz()
    }

    /// Value of a control.
    pub fn control(&self, id: u32) -> io::Result<i32> {
        let mut control = sys::v4l2_control { id, value: 0 };
        // SAFETY: G_CTRL is declared for v4l2_control.
        unsafe { self.ioctl(vidioc::VIDIOC_G_CTRL, &mut control)? };
        Ok(control.value)
    }

    /// Sets a control.
    pub fn set_control(&self, id: u32, value: i32) -> io::Result<()> {
        let mut control = sys::v4l2_control { id, value };
        // SAFETY: S_CTRL is declared for v4l2_control.
        unsafe { self.ioctl(vidioc::VIDIOC_S_CTRL, &mut control) }
    }

    /// Which values a control may have; an error if the camera has none such.
    pub fn control_range(&self, id: u32) -> io::Result<ControlRange> {
        let mut query: sys::v4l2_queryctrl = zeroed();
        query.id = id;
        // SAFETY: QUERYCTRL is declared for v4l2_queryctrl.
        unsafe { self.ioctl(vidioc::VIDIOC_QUERYCTRL, &mut query)? };
        if query.flags & CONTROL_DISABLED != 0 {
            return Err(io::Error::new(io::ErrorKind::NotFound, "the control is disabled for good"));
        }
        let (low, high) = (query.minimum, query.maximum);
        Ok(ControlRange { low, high, step: query.step, default: query.default_value })
    }

    /// REQBUFS; how many were granted.
    pub(super) fn request_buffers(&self, count: u32) -> io::Result<u32> {
        let mut request: sys::v4l2_requestbuffers = zeroed();
        (request.count, request.type_, request.memory) = (count, CAPTURE, MMAP);
        // SAFETY: REQBUFS is declared for v4l2_requestbuffers.
        unsafe { self.ioctl(vidioc::VIDIOC_REQBUFS, &mut request)? };
        Ok(request.count)
    }

    /// One of QUERYBUF, QBUF and DQBUF.
    pub(super) fn buffer(&self, request: vidioc::_IOC_TYPE, index: u32) -> io::Result<sys::v4l2_buffer> {
        let mut buffer: sys::v4l2_buffer = zeroed();
        (buffer.index, buffer.type_, buffer.memory) = (index, CAPTURE, MMAP);
        // SAFETY: the three requests are declared for v4l2_buffer, and for single-planar mapped buffers its union holds an
        // offset and not a pointer.
        unsafe { self.ioctl(request, &mut buffer)? };
        Ok(buffer)
    }

    pub(super) fn stream(&self, request: vidioc::_IOC_TYPE) -> io::Result<()> {
        let mut kind = CAPTURE as libc::c_int;
        // SAFETY: STREAMON and STREAMOFF are declared for int.
        unsafe { self.ioctl(request, &mut kind) }
    }
}

fn from_fraction(f: sys::v4l2_fract) -> Interval {
    Interval { numerator: f.numerator, denominator: f.denominator }
}

/// Bytes up to the first zero, readable.
fn text(bytes: &[u8]) -> String {
    let end = bytes.iter().position(|b| *b == 0).unwrap_or(bytes.len());
    String::from_utf8_lossy(bytes.get(..end).unwrap_or_default()).trim().to_string()
}

/// The kernel's structs that are used here: integers, arrays and unions of them.
trait Plain {}
impl Plain for sys::v4l2_capability {}
impl Plain for sys::v4l2_fmtdesc {}
impl Plain for sys::v4l2_frmsizeenum {}
impl Plain for sys::v4l2_frmivalenum {}
impl Plain for sys::v4l2_format {}
impl Plain for sys::v4l2_pix_format {}
impl Plain for sys::v4l2_streamparm {}
impl Plain for sys::v4l2_requestbuffers {}
impl Plain for sys::v4l2_buffer {}
impl Plain for sys::v4l2_queryctrl {}

fn zeroed<T: Plain>() -> T {
    // SAFETY: all-zero bytes are a value of every `Plain` struct.
    unsafe { std::mem::zeroed() }
}
