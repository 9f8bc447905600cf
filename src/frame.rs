//! One captured frame as it travels from a source to the feature thread, before decoding.

/// How the bytes of a [`RawFrame`] are to be read.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum PixelFormat {
    /// 8-bit grey, `stride` bytes a row.
    #[default]
    Grey,
    /// Packed 4:2:2, Y0 U Y1 V, `stride` bytes a row. Sources that can convert while copying hand over `Grey` instead.
    Yuyv,
    /// A JPEG or a webcam's motion JPEG (possibly without Huffman tables).
    Jpeg,
    /// A PNG file's bytes, 8 or 16 bit, grey or colour.
    Png,
}

/// What a frame's `timestamp_ns` counts from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Clock {
    /// CLOCK_MONOTONIC of the capture.
    #[default]
    Monotonic,
    /// The recording's own time.
    Recording,
}

/// A reusable buffer with one frame in it. The buffer keeps its capacity between frames.
#[derive(Debug, Clone, Default)]
pub struct RawFrame {
    /// Counts every frame that the source saw, dropped ones too; 0 is the first.
    pub sequence: u64,
    /// Capture time in the source's clock, ns.
    pub timestamp_ns: i64,
    /// CLOCK_MONOTONIC when the frame arrived in this process, ns.
    pub arrival_ns: i64,
    pub format: PixelFormat,
    /// Size in pixels; 0 where only decoding tells (JPEG, PNG).
    pub width: u32,
    pub height: u32,
    /// Bytes a row for `Grey` and `Yuyv`.
    pub stride: u32,
    pub data: Vec<u8>,
}

/// CLOCK_MONOTONIC now, ns.
pub fn monotonic_ns() -> i64 {
    clock_ns(libc::CLOCK_MONOTONIC)
}

/// CPU time that all threads of this process have used, ns.
pub fn process_cpu_ns() -> i64 {
    clock_ns(libc::CLOCK_PROCESS_CPUTIME_ID)
}

fn clock_ns(clock: libc::clockid_t) -> i64 {
    let mut t = libc::timespec { tv_sec: 0, tv_nsec: 0 };
    // SAFETY: `t` is a valid, writable timespec and the clock id is a constant that the kernel knows.
    unsafe { libc::clock_gettime(clock, &mut t) };
    // The fields are 32 bits wide on some targets.
    #[allow(clippy::unnecessary_cast)]
    let (seconds, nanoseconds) = (t.tv_sec as i64, t.tv_nsec as i64);
    seconds * 1_000_000_000 + nanoseconds
}
