//! Colours as `0xRRGGBB`.

pub const PAPER: u32 = 0xffffff;
pub const INK: u32 = 0x1f2933;
pub const MUTED: u32 = 0x616e7c;
pub const GRID: u32 = 0xe4e7eb;
pub const FRAME: u32 = 0x9aa5b1;
pub const TRUTH: u32 = 0xa3adb8;
pub const ESTIMATE: u32 = 0x1d6fd8;
pub const ROTATION: u32 = 0x8a3fc7;
pub const LOST: u32 = 0xd64545;
pub const LANDMARK: u32 = 0x2f4b6b;
pub const KEYFRAME: u32 = 0xf08a24;
pub const START: u32 = 0x199e5b;
/// The method's colours: corners and cameras red, matches green, points blue.
pub const CORNER: u32 = 0xe02020;
pub const MATCH: u32 = 0x14b814;
pub const OUTLIER: u32 = 0xe0a020;
pub const POINT: u32 = 0x1d4fd8;
/// Told apart by colour-blind eyes too (Okabe & Ito).
pub const CATEGORIES: [u32; 7] = [0x0072b2, 0xe69f00, 0x009e73, 0xcc79a7, 0xd55e00, 0x56b4e9, 0xf0e442];

/// From dark violet (0) over teal to yellow (1): ordered in lightness too, so it survives grey printing.
pub fn sequential(t: f64) -> u32 {
    const STOPS: [(f64, f64, f64); 6] = [
        (68.0, 1.0, 84.0),
        (65.0, 68.0, 135.0),
        (42.0, 120.0, 142.0),
        (34.0, 168.0, 132.0),
        (122.0, 209.0, 81.0),
        (240.0, 215.0, 30.0),
    ];
    let at = if t.is_finite() { t.clamp(0.0, 1.0) } else { 0.0 } * (STOPS.len() - 1) as f64;
    let below = (at.floor() as usize).min(STOPS.len() - 2);
    let f = at - below as f64;
    let (a, b) = (STOPS[below], STOPS[below + 1]);
    let mix = |a: f64, b: f64| (a + f * (b - a)).round() as u32;
    mix(a.0, b.0) << 16 | mix(a.1, b.1) << 8 | mix(a.2, b.2)
}
