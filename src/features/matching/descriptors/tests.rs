use super::*;
use crate::geometry::random::Random;
use proptest::prelude::*;

/// Random bits from a seed.
fn draw(n: usize, seed: u64) -> Vec<Descriptor> {
    let mut random = Random::new(seed);
    (0..n).map(|_| Descriptor(std::array::from_fn(|_| random.bits()))).collect()
}

/// Flips every bit k with k % 32 < n of 256: 8 n bits.
fn spoil(d: &Descriptor, n: u32) -> Descriptor {
    let mask = (0..n).fold(0u64, |m, k| m | 1 << k | 1 << (k + 32));
    Descriptor(d.0.map(|w| w ^ mask))
}

#[test]
fn shuffled_and_spoiled_descriptors_find_each_other() {
    let first = draw(90, 7);
    let second: Vec<_> = (0..90).map(|j| spoil(&first[(j * 7) % 90], 3)).collect();
    let mut out = Vec::new();
    DescriptorMatcher::default().match_all(&first, &second, &DescriptorMatching::default(), &mut out);
    assert_eq!(out.len(), 90);
    for m in &out {
        assert_eq!((m.second as usize * 7) % 90, m.first as usize);
        assert_eq!(m.distance, 24.0);
    }
    assert!(out.is_sorted_by_key(|m| m.first));
}

#[test]
fn what_is_not_mutual_or_not_clear_or_too_far_is_left_out() {
    let d = draw(4, 3);
    let run = |first: &[Descriptor], second: &[Descriptor], rule| {
        let mut out = Vec::new();
        DescriptorMatcher::default().match_all(first, second, &rule, &mut out);
        out.iter().map(|m| (m.first, m.second)).collect::<Vec<_>>()
    };
    let any = DescriptorMatching { max_distance: 256, max_ratio: 1.0 };
    // Two of the first want the same of the second: the nearer gets it.
    assert_eq!(run(&[spoil(&d[0], 2), spoil(&d[0], 1)], &[d[0]], any), [(1, 0)]);
    // Two equal ones: the first when nothing is asked, none when a ratio is.
    assert_eq!(run(&[d[0]], &[d[0], d[0]], any), [(0, 0)]);
    assert_eq!(run(&[d[0]], &[d[0], d[0]], DescriptorMatching::default()), []);
    // The same seen from the other side.
    assert_eq!(run(&[d[0], d[0]], &[d[0]], DescriptorMatching::default()), []);
    // Too far.
    let near = DescriptorMatching { max_distance: 15, max_ratio: 1.0 };
    assert_eq!(run(&[d[0]], &[spoil(&d[0], 2)], near), []);
    assert_eq!(run(&[d[0]], &[spoil(&d[0], 1)], near), [(0, 0)]);
    assert_eq!(run(&[], &d, any), []);
    assert_eq!(run(&d, &[], any), []);
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, ..ProptestConfig::default() })]

    #[test]
    fn the_wide_kernel_agrees_with_its_scalar_twin(n in 0usize..20, m in 0usize..20, seed in any::<u64>()) {
        let (a, b) = (draw(n, seed), draw(m, seed.wrapping_add(1)));
        type Kernel = fn(&[Descriptor], &[Descriptor], &mut [Nearest<u16>], &mut [Nearest<u16>]);
        let run = |f: Kernel| {
            let (mut rows, mut columns) = (vec![Nearest::none(u16::MAX); n], vec![Nearest::none(u16::MAX); m]);
            f(&a, &b, &mut rows, &mut columns);
            rows.iter().chain(&columns).map(|x| (x.distance, x.second, x.index)).collect::<Vec<_>>()
        };
        prop_assert_eq!(run(nearest_of_all), run(nearest_of_all_body));
        let mut sorted: Vec<u32> = b.iter().flat_map(|b| a.first().map(|a| a.distance(b))).collect();
        sorted.sort();
        if n > 0 && m > 1 {
            let row = run(nearest_of_all)[0];
            prop_assert_eq!((u32::from(row.0), u32::from(row.1)), (sorted[0], sorted[1]));
        }
    }
}
