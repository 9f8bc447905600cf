//! What every two-view estimator wants to know of its points before it starts: are they finite, how are they spread,
//! and in which coordinates are their equations well conditioned.
//!
//! Cost: two passes over the points.

use nalgebra::{Matrix3, Vector2};

/// Conditioning of matched points (Hartley, In defence of the eight-point algorithm, PAMI 1997): each picture is moved
/// to its centroid and *both are scaled by the same factor*, so that distances of the two pictures keep their ratio and
/// thresholds scale along.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Conditioning {
    pub centroid1: Vector2<f64>,
    pub centroid2: Vector2<f64>,
    /// Conditioned length = scale * length.
    pub scale: f64,
}

impl Conditioning {
    /// `None` for different lengths, no points, points that are not finite or all in one place.
    pub fn of(x1: &[Vector2<f64>], x2: &[Vector2<f64>]) -> Option<Self> {
        if x1.len() != x2.len() || x1.is_empty() {
            return None;
        }
        let n = x1.len() as f64;
        let centroid = |x: &[Vector2<f64>]| x.iter().sum::<Vector2<f64>>() / n;
        let (centroid1, centroid2) = (centroid(x1), centroid(x2));
        let spread = |x: &[Vector2<f64>], c: &Vector2<f64>| x.iter().map(|p| (p - c).norm()).sum::<f64>() / n;
        let mean = 0.5 * (spread(x1, &centroid1) + spread(x2, &centroid2));
        let scale = std::f64::consts::SQRT_2 / mean;
        // NaN and infinity reach `mean`; a single place makes it zero.
        (mean.is_finite() && mean > 0.0 && scale.is_finite()).then_some(Self { centroid1, centroid2, scale })
    }

    /// A point of the first picture in conditioned coordinates.
    #[inline]
    pub fn first(&self, x: &Vector2<f64>) -> Vector2<f64> {
        (x - self.centroid1) * self.scale
    }

    /// A point of the second picture in conditioned coordinates.
    #[inline]
    pub fn second(&self, x: &Vector2<f64>) -> Vector2<f64> {
        (x - self.centroid2) * self.scale
    }

    /// 3x3 matrix of [`Conditioning::first`].
    pub fn matrix1(&self) -> Matrix3<f64> {
        similarity(&self.centroid1, self.scale)
    }

    /// 3x3 matrix of [`Conditioning::second`].
    pub fn matrix2(&self) -> Matrix3<f64> {
        similarity(&self.centroid2, self.scale)
    }
}

fn similarity(centroid: &Vector2<f64>, scale: f64) -> Matrix3<f64> {
    Matrix3::new(scale, 0.0, -scale * centroid.x, 0.0, scale, -scale * centroid.y, 0.0, 0.0, 1.0)
}

/// Are all coordinates finite?
pub fn all_finite(x: &[Vector2<f64>]) -> bool {
    // A sum of finite numbers can overflow only far beyond any picture; one that is not finite always shows.
    x.iter().map(|p| p.x.abs() + p.y.abs()).sum::<f64>().is_finite()
}

/// Root mean square distance from the centroid along the widest direction, and across it. The second is how far the
/// points are from lying on one line.
pub fn spread(points: impl Iterator<Item = Vector2<f64>> + Clone) -> (f64, f64) {
    let count = points.clone().count().max(1) as f64;
    let mean = points.clone().sum::<Vector2<f64>>() / count;
    let (mut a, mut b, mut c) = (0.0, 0.0, 0.0);
    for p in points {
        let d = p - mean;
        a += d.x * d.x;
        b += d.x * d.y;
        c += d.y * d.y;
    }
    let (a, b, c) = (a / count, b / count, c / count);
    let middle = 0.5 * (a + c);
    let radius = (0.25 * (a - c) * (a - c) + b * b).sqrt();
    // The small eigenvalue by the determinant: no cancellation for points on a line.
    let large = middle + radius;
    let small = if large > 0.0 { (a * c - b * b) / large } else { 0.0 };
    (large.sqrt(), small.max(0.0).sqrt())
}

/// Lowest and highest corner of the box around the points; `None` without points.
pub fn bounding_box(x: &[Vector2<f64>]) -> Option<(Vector2<f64>, Vector2<f64>)> {
    let first = x.first()?;
    Some(x.iter().fold((*first, *first), |(low, high), p| (low.inf(p), high.sup(p))))
}

/// Width and height of the box around the points.
fn size(x: &[Vector2<f64>]) -> Vector2<f64> {
    bounding_box(x).map_or_else(Vector2::zeros, |(low, high)| high - low)
}

/// Probability that a random point of the box around `x` is within `threshold` of a given line through it.
pub fn chance_near_line(x: &[Vector2<f64>], threshold: f64) -> f64 {
    let size = size(x);
    // A box as thin as the band: no line stands out.
    let area = (size.x * size.y).max(f64::MIN_POSITIVE);
    (2.0 * threshold * size.norm() / area).min(1.0)
}

/// Probability that a random point of the box around `x` is within `threshold` of a given point.
pub fn chance_near_point(x: &[Vector2<f64>], threshold: f64) -> f64 {
    let size = size(x);
    let area = (size.x * size.y).max(f64::MIN_POSITIVE);
    (std::f64::consts::PI * threshold * threshold / area).min(1.0)
}

/// Probability that a match which belongs somewhere else, displaced from there by `distance` in any direction, lies within `threshold`
/// (a Sampson distance, which shares the error out between both pictures) of a given line through that place: `2/pi asin(T/d)`.
pub fn chance_displaced(distance: f64, threshold: f64) -> f64 {
    let across = std::f64::consts::SQRT_2 * threshold;
    if distance > across { (across / distance).asin() * std::f64::consts::FRAC_2_PI } else { 1.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn conditioned_points_are_centred_and_keep_the_ratio_of_the_pictures() {
        let x1 = [Vector2::new(100.0, 50.0), Vector2::new(300.0, 80.0), Vector2::new(120.0, 400.0)];
        let x2 = [Vector2::new(10.0, 5.0), Vector2::new(30.0, 8.0), Vector2::new(12.0, 40.0)];
        let c = Conditioning::of(&x1, &x2).expect("finite");
        let sum: Vector2<f64> = x1.iter().map(|p| c.first(p)).sum();
        assert!(sum.norm() < 1e-13);
        let ratio = c.first(&x1[0]).norm() / c.second(&x2[0]).norm();
        assert!((ratio - 10.0).abs() < 1e-12);
        let by_matrix = c.matrix1() * x1[1].push(1.0);
        assert!((by_matrix.xy() - c.first(&x1[1])).norm() < 1e-13);
    }

    #[test]
    fn bad_points_have_no_conditioning() {
        let p = Vector2::new(1.0, 2.0);
        assert!(Conditioning::of(&[], &[]).is_none());
        assert!(Conditioning::of(&[p], &[p, p]).is_none());
        assert!(Conditioning::of(&[p, p], &[p, p]).is_none());
        assert!(Conditioning::of(&[p, Vector2::new(f64::NAN, 0.0)], &[p, p]).is_none());
        assert!(!all_finite(&[p, Vector2::new(f64::INFINITY, 0.0)]));
        assert!(all_finite(&[p, p]));
    }

    #[test]
    fn spread_of_a_line_is_zero_across() {
        let line: Vec<Vector2<f64>> = (0..20).map(|i| Vector2::new(3.0, 4.0) * f64::from(i)).collect();
        let (along, across) = spread(line.iter().copied());
        assert!(across < 1e-5 && along > 20.0, "{along} {across}");
    }
}
