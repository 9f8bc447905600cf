//! The nearest and the second nearest, in both directions: what "mutual and unambiguous" is decided from.
//!
//! Input: distances of pairs (i, j) in any order that ascends in i for each j and in j for each i. Output: [`mutual`]
//! hands out the pairs in which each is the other's nearest. Of equally near ones the first offered stays the nearest.
//! Cost: two comparisons an offer. It deliberately knows nothing of what is compared.

/// The nearest and the second nearest seen so far.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(in crate::features) struct Nearest<D> {
    pub distance: D,
    /// `D`'s largest while there is no second.
    pub second: D,
    pub index: u32,
}

impl<D: PartialOrd + Copy> Nearest<D> {
    /// Nothing seen; `farthest` is above every distance that will be offered.
    pub const fn none(farthest: D) -> Self {
        Self { distance: farthest, second: farthest, index: u32::MAX }
    }

    #[inline(always)]
    pub fn offer(&mut self, distance: D, index: u32) {
        if distance < self.second {
            if distance < self.distance {
                *self = Self { distance, second: self.distance, index };
            } else {
                self.second = distance;
            }
        }
    }
}

/// Makes `nearest` `n` long with nothing seen.
pub(in crate::features) fn start<D: PartialOrd + Copy>(nearest: &mut Vec<Nearest<D>>, n: usize, farthest: D) {
    nearest.clear();
    nearest.resize(n, Nearest::none(farthest));
}

/// Pairs (first, second) that are each other's nearest, ascending in the first, with what both sides saw.
pub(in crate::features) fn mutual<'a, D: PartialOrd + Copy>(
    rows: &'a [Nearest<D>],
    columns: &'a [Nearest<D>],
) -> impl Iterator<Item = (u32, &'a Nearest<D>, &'a Nearest<D>)> {
    rows.iter().enumerate().filter_map(|(i, row)| {
        let column = columns.get(row.index as usize)?;
        (column.index as usize == i).then_some((i as u32, row, column))
    })
}
