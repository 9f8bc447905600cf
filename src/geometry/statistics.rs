//! Of a set of numbers.

/// Standard deviation of a normal distribution over the median of its deviations' magnitudes.
pub const SIGMA_OVER_MEDIAN: f64 = 1.4826;

/// The upper one of an even number; `None` of nothing. Reorders `values`. Cost: linear.
pub fn median(values: &mut [f64]) -> Option<f64> {
    let middle = values.len() / 2;
    (!values.is_empty()).then(|| *values.select_nth_unstable_by(middle, f64::total_cmp).1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_median_is_the_upper_middle_in_any_order() {
        assert_eq!(median(&mut []), None);
        assert_eq!(median(&mut [3.0]), Some(3.0));
        assert_eq!(median(&mut [4.0, -1.0, 2.0]), Some(2.0));
        assert_eq!(median(&mut [f64::INFINITY, 1.0, 4.0, 2.0]), Some(4.0));
    }
}
