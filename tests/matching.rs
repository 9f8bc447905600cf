//! Matchers on a real rectified stereo pair with known disparity (Middlebury's motorcycle).
//! Skipped with a message where the pictures are not there (`CAIRN_DATA`).

#[path = "support/recordings.rs"]
mod recordings;

use std::io::Read;

use cairn::features::Corner;
use cairn::features::correlation::{CornerCorrelator, CorrelationMatching, EpipolarCorrelator, EpipolarSearch};
use cairn::features::fast::FastDetector;
use cairn::features::matching::{FlowMatching, match_flow};
use cairn::frame::{PixelFormat, RawFrame};
use cairn::image::decode::Decoder;
use cairn::image::{GreyImage, Pyramid};
use nalgebra::{Matrix3, Vector2};
use recordings::recording;

/// Left, right, and the left picture's disparity: x_right = x_left - disparity; not finite where unknown.
struct Stereo {
    left: GreyImage,
    right: GreyImage,
    disparity: Vec<f32>,
}

fn stereo() -> Option<Stereo> {
    let folder = recording("two_view/motorcycle")?;
    let picture = |name: &str| {
        let mut grey = GreyImage::default();
        let data = std::fs::read(folder.join(name)).expect("picture");
        let frame = RawFrame { format: PixelFormat::Png, data, ..RawFrame::default() };
        Decoder::default().decode(&frame, &mut grey).expect("PNG");
        grey
    };
    let (left, right) = (picture("motorcycle_left.png"), picture("motorcycle_right.png"));
    let disparity = only_array(&std::fs::read(folder.join("motorcycle_disp.npz")).expect("npz"));
    assert_eq!(disparity.len(), left.data.len());
    Some(Stereo { left, right, disparity })
}

/// The one array of 32-bit floats of an `npz`: a zip file whose first member begins at its first byte.
fn only_array(npz: &[u8]) -> Vec<f32> {
    let u16_at = |at: usize| usize::from(u16::from_le_bytes([npz[at], npz[at + 1]]));
    assert_eq!((&npz[..4], u16_at(8)), (&b"PK\x03\x04"[..], 8), "a deflated member");
    let mut npy = Vec::new();
    flate2::read::DeflateDecoder::new(&npz[30 + u16_at(26) + u16_at(28)..]).read_to_end(&mut npy).expect("deflate");
    assert_eq!(&npy[..8], b"\x93NUMPY\x01\x00");
    let begin = 10 + usize::from(u16::from_le_bytes([npy[8], npy[9]]));
    assert!(String::from_utf8_lossy(&npy[..begin]).contains("'<f4', 'fortran_order': False"));
    npy[begin..].chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect()
}

impl Stereo {
    /// The strongest `n` corners.
    fn corners(&self, image: &GreyImage, n: usize) -> Vec<Corner> {
        let mut out = Vec::new();
        FastDetector::new().detect_all(image, 12, &mut out);
        out.sort_by(|a, b| b.response.total_cmp(&a.response));
        out.truncate(n);
        out
    }

    /// How far a place is from the truth, px; `None` where that is unknown.
    fn error_px(&self, corner: &Corner, place: Vector2<f32>) -> Option<f32> {
        let d = self.disparity[corner.y as usize * self.left.width + corner.x as usize];
        d.is_finite().then(|| (place - Vector2::new(corner.x - d, corner.y)).norm())
    }

    /// (places with a truth, of these within 2 px, median error of those in px).
    fn judge(&self, places: impl Iterator<Item = (Corner, Vector2<f32>)>) -> (usize, usize, f32) {
        let errors: Vec<f32> = places.filter_map(|(c, p)| self.error_px(&c, p)).collect();
        let mut right: Vec<f32> = errors.iter().copied().filter(|e| *e < 2.0).collect();
        right.sort_by(f32::total_cmp);
        (errors.len(), right.len(), right.get(right.len() / 2).copied().unwrap_or(f32::NAN))
    }
}

#[test]
fn correlation_along_epipolar_lines_finds_the_true_disparity() {
    let Some(stereo) = stereo() else { return };
    let rows = Matrix3::new(0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0);
    let corners = stereo.corners(&stereo.left, 300);
    let mut lines = EpipolarCorrelator::new(CorrelationMatching::default(), EpipolarSearch::default()).unwrap();
    let mut out = Vec::new();
    lines.match_lines(&stereo.left, &stereo.right, &rows, &corners, &mut out);
    let judged = stereo.judge(out.iter().map(|m| (corners[m.first as usize], m.position)));
    let (known, right, median) = judged;
    assert!(known >= 150 && right * 10 >= known * 9 && median < 0.25, "known, right, median px: {judged:?}");
}

#[test]
fn correlation_of_corners_and_optical_flow_agree_with_the_disparity_without_knowing_the_lines() {
    let Some(stereo) = stereo() else { return };
    let (left, right) = (stereo.corners(&stereo.left, 600), stereo.corners(&stereo.right, 600));
    let mut out = Vec::new();
    let mut correlator = CornerCorrelator::new(CorrelationMatching::default()).unwrap();
    correlator.match_all((&stereo.left, &left), (&stereo.right, &right), &mut out);
    let place = |j: u32| Vector2::new(right[j as usize].x, right[j as usize].y);
    let judged = stereo.judge(out.iter().map(|m| (left[m.first as usize], place(m.second))));
    assert!(judged.0 >= 100 && judged.1 * 10 >= judged.0 * 8, "corners: known, right, median px: {judged:?}");

    let (mut first, mut second) = (Pyramid::new(6), Pyramid::new(6));
    first.build(&stereo.left);
    second.build(&stereo.right);
    let mut out = Vec::new();
    match_flow(&first, &second, &left, &FlowMatching::default(), &mut out);
    let judged = stereo.judge(out.iter().map(|m| (left[m.first as usize], m.position)));
    assert!(judged.0 >= 200 && judged.1 * 10 >= judged.0 * 8, "flow: known, right, median px: {judged:?}");
}
