use super::*;
use crate::geometry::Se3;
use crate::geometry::random::Random;

fn placed(edge: f64, corner_sigma: f64, view_sigma: f64) -> PlacedTag {
    PlacedTag {
        world_from_tag: Se3::identity(),
        log_edge: edge.ln(),
        corner_variance: corner_sigma * corner_sigma,
        view_variance: view_sigma * view_sigma,
        residual_px: 0.2,
        views: 10,
    }
}

fn config(size_sigma_m: f64) -> TagConfig {
    TagConfig { size_m: 0.15, size_sigma_m, ids: Vec::new() }
}

fn combined(tags: &[PlacedTag], config: &TagConfig) -> ScaleMeasurement {
    combine(tags.iter(), config).expect("sure enough")
}

#[test]
fn one_tag_says_metres_per_map_unit() {
    let found = combined(&[placed(0.05, 0.003, 0.004)], &config(0.0));
    assert!((found.log_metres_per_unit - 3f64.ln()).abs() < 1e-12);
    assert!((found.sigma - 0.005).abs() < 1e-12 && found.source == ScaleSource::Tag);
    // 1.5 mm of 150.
    assert!((combined(&[placed(0.05, 0.0, 0.0001)], &config(0.0015)).sigma - 0.01).abs() < 1e-5);
    assert_eq!(combine([].iter(), &config(0.0)), None);
    assert_eq!(combine([placed(0.05, 0.2, 0.0)].iter(), &config(0.0)), None, "not sure enough");
}

#[test]
fn more_tags_average_their_corners_and_not_the_keyframes() {
    let corners = combined(&[placed(0.05, 0.01, 0.0); 4], &config(0.0)).sigma;
    let keyframes = combined(&[placed(0.05, 0.0, 0.01); 4], &config(0.0)).sigma;
    assert!((corners - 0.005).abs() < 1e-12 && (keyframes - 0.01).abs() < 1e-12, "{corners} {keyframes}");
}

#[test]
fn tags_that_disagree_raise_the_sigma_and_one_of_another_size_is_left_out() {
    let agree = combined(&[0.05, 0.05, 0.05].map(|e| placed(e, 0.002, 0.0)), &config(0.0)).sigma;
    let differ = combined(&[0.0492, 0.05, 0.0508].map(|e| placed(e, 0.002, 0.0)), &config(0.0)).sigma;
    assert!(differ > 5.0 * agree, "{differ} {agree}");
    let with_stranger = combined(&[0.05, 0.05, 0.05, 0.08].map(|e| placed(e, 0.002, 0.0)), &config(0.0));
    assert!((with_stranger.log_metres_per_unit - 3f64.ln()).abs() < 1e-9);
}

#[test]
fn several_tags_with_common_errors_of_the_keyframes_keep_the_truth_in_the_interval() {
    let mut inside = 0;
    for seed in 0..200 {
        let random = &mut Random::new(seed);
        let common = random.normal() * 0.004;
        let truth = 0.05f64;
        let tags: Vec<PlacedTag> =
            (0..5).map(|_| placed(truth * (common + 0.006 * random.normal()).exp(), 0.006, 0.004)).collect();
        let found = combined(&tags, &config(0.0));
        inside += usize::from((found.log_metres_per_unit - 3f64.ln()).abs() <= 1.96 * found.sigma);
    }
    assert!((180..=196).contains(&inside), "{inside} of 200 inside");
}

#[test]
fn wrong_values_of_the_configuration_are_named() {
    let key = |size_m, size_sigma_m, ids: &[u16]| {
        TagConfig { size_m, size_sigma_m, ids: ids.to_vec() }.validate().map_err(|(key, _)| key)
    };
    assert_eq!(key(0.0, 0.0003, &[]), Ok(()));
    assert_eq!(key(0.15, 0.0003, &[0, 586]), Ok(()));
    for size_m in [15.0, -0.1, 0.001, f64::NAN, f64::INFINITY] {
        assert_eq!(key(size_m, 0.0003, &[]), Err("size_m"), "{size_m}");
    }
    for sigma in [-0.001, 0.02, f64::NAN] {
        assert_eq!(key(0.15, sigma, &[]), Err("size_sigma_m"), "{sigma}");
    }
    assert_eq!(key(0.15, 0.0003, &[587]), Err("ids"));
    assert!(Tags::new(&TagConfig::default()).is_none());
}
