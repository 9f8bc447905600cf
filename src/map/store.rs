//! Paged storage by ascending ids that are never reused.
//!
//! Lookup is O(1), iteration is in ascending id (deterministic), and a page whose entries are all removed is freed, so that
//! memory follows what is alive and not what ever was: 16 bytes remain of each 64 removed ids.
//!
//! It also knows which entries have changed since that was asked last, for who keeps a copy elsewhere (a file), and which were touched at all, for
//! who judges them: a bit an entry each.

/// Entries of a page: as many as a word has bits.
pub const PAGE: usize = 64;

struct Page<T> {
    /// Slots that are alive, a bit each: who asks which ids there are need not look at the entries.
    alive: u64,
    slots: [Option<T>; PAGE],
}

/// Map from a dense, growing `u32` id to `T`.
pub struct Store<T> {
    pages: Vec<Option<Box<Page<T>>>>,
    /// A bit for each entry of a page that was put, changed or removed; may be shorter than `pages`.
    changed: Vec<u64>,
    /// The same, for every change at all; as long as `changed`.
    touched: Vec<u64>,
    next: u32,
    live: usize,
}

impl<T> Default for Store<T> {
    fn default() -> Self {
        Self { pages: Vec::new(), changed: Vec::new(), touched: Vec::new(), next: 0, live: 0 }
    }
}

impl<T> Store<T> {
    /// The id that the next [`insert`](Self::insert) will use.
    pub fn next_id(&self) -> u32 {
        self.next
    }

    /// An empty one whose ids go on after these.
    pub fn successor(&self) -> Self {
        Self { next: self.next, ..Self::default() }
    }

    /// Moves all entries of another here, which must have none of the same ids.
    pub fn absorb(&mut self, other: Self) {
        self.next = self.next.max(other.next);
        for (p, page) in other.pages.into_iter().enumerate() {
            for (s, value) in page.into_iter().flat_map(|page| page.slots).enumerate() {
                if let Some(value) = value {
                    self.put((p * PAGE + s) as u32, value);
                }
            }
        }
    }

    /// Number of entries alive.
    pub fn len(&self) -> usize {
        self.live
    }

    /// No entry is alive.
    pub fn is_empty(&self) -> bool {
        self.live == 0
    }

    /// Stores `value` under the next id.
    pub fn insert(&mut self, value: T) -> u32 {
        let id = self.next;
        self.next += 1;
        self.put(id, value);
        id
    }

    /// Stores `value` under an id of a copy that was kept elsewhere; the next id is above it.
    pub(super) fn restore(&mut self, id: u32, value: T) {
        self.next = self.next.max(id.saturating_add(1));
        self.put(id, value);
    }

    /// The next id is at least this one.
    pub(super) fn skip_to(&mut self, next: u32) {
        self.next = self.next.max(next);
    }

    /// Ids of the entries that were put, changed or removed since the last call, ascending.
    pub fn take_changed(&mut self) -> Vec<u32> {
        taken(&mut self.changed)
    }

    /// Ids of the entries that were put, removed, or handed out to be changed in any way since the last call, ascending.
    pub(super) fn take_touched(&mut self) -> Vec<u32> {
        taken(&mut self.touched)
    }

    /// It is told by the next [`take_touched`](Self::take_touched) again.
    pub(super) fn touch(&mut self, id: u32) {
        if let Some(word) = self.touched.get_mut(id as usize / PAGE) {
            *word |= 1 << (id as usize % PAGE);
        }
    }

    /// Whether the entry is alive.
    pub fn contains(&self, id: u32) -> bool {
        let page = self.pages.get(id as usize / PAGE).and_then(Option::as_ref);
        page.is_some_and(|page| page.alive >> (id as usize % PAGE) & 1 == 1)
    }

    /// Ids of the entries that are alive, ascending.
    pub fn ids(&self) -> impl Iterator<Item = u32> {
        self.ids_from(0)
    }

    /// The same from this one on.
    pub fn ids_from(&self, first: u32) -> impl Iterator<Item = u32> {
        let (page, slot) = (first as usize / PAGE, first as usize % PAGE);
        let alive = |p: usize| self.pages[p].as_ref().map_or(0, |page| page.alive);
        let words =
            (page..self.pages.len()).map(move |p| (p, if p == page { alive(p) & u64::MAX << slot } else { alive(p) }));
        words.flat_map(|(p, word)| bits(word).map(move |slot| (p * PAGE + slot) as u32))
    }

    /// The entry alive whose id is the largest below this one.
    pub fn last_before(&self, id: u32) -> Option<u32> {
        let (page, slot) = (id as usize / PAGE, id as usize % PAGE);
        (0..self.pages.len().min(page + 1)).rev().find_map(|p| {
            let alive = self.pages[p].as_ref()?.alive;
            let below = if p == page { alive & !(u64::MAX << slot) } else { alive };
            (below != 0).then(|| (p * PAGE) as u32 + below.ilog2())
        })
    }

    /// Whether there are any.
    pub fn has_changed(&self) -> bool {
        self.changed.iter().any(|word| *word != 0)
    }

    fn mark(&mut self, id: u32) {
        let page = id as usize / PAGE;
        if page >= self.changed.len() {
            self.changed.resize(page + 1, 0);
            self.touched.resize(page + 1, 0);
        }
        self.changed[page] |= 1 << (id as usize % PAGE);
        self.touched[page] |= 1 << (id as usize % PAGE);
    }

    /// Those alive; what was removed before stays marked.
    fn mark_all(&mut self) {
        for marks in [&mut self.changed, &mut self.touched] {
            marks.resize(marks.len().max(self.pages.len()), 0);
            marks.iter_mut().zip(&self.pages).for_each(|(word, page)| *word |= page.as_ref().map_or(0, |p| p.alive));
        }
    }

    fn put(&mut self, id: u32, value: T) {
        self.mark(id);
        let (page, slot) = (id as usize / PAGE, id as usize % PAGE);
        if page >= self.pages.len() {
            self.pages.resize_with(page + 1, || None);
        }
        let page = self.pages[page].get_or_insert_with(|| Box::new(Page { alive: 0, slots: [const { None }; PAGE] }));
        if page.slots[slot].replace(value).is_none() {
            page.alive |= 1 << slot;
            self.live += 1;
        }
    }

    /// The entry, if it is alive.
    pub fn get(&self, id: u32) -> Option<&T> {
        self.pages.get(id as usize / PAGE)?.as_ref()?.slots[id as usize % PAGE].as_ref()
    }

    /// The entry, if it is alive; it counts as changed.
    pub(super) fn get_mut(&mut self, id: u32) -> Option<&mut T> {
        self.get(id)?;
        self.mark(id);
        self.get_mut_unnoticed(id)
    }

    /// The entry, if it is alive, for a change that is worth no copy by itself.
    pub(super) fn get_mut_unnoticed(&mut self, id: u32) -> Option<&mut T> {
        self.touch(id);
        self.pages.get_mut(id as usize / PAGE)?.as_mut()?.slots[id as usize % PAGE].as_mut()
    }

    /// Takes the entry out.
    pub fn remove(&mut self, id: u32) -> Option<T> {
        self.get(id)?;
        self.mark(id);
        let page = self.pages.get_mut(id as usize / PAGE)?;
        let inner = page.as_mut()?;
        let value = inner.slots[id as usize % PAGE].take()?;
        inner.alive &= !(1 << (id as usize % PAGE));
        self.live -= 1;
        if inner.alive == 0 {
            *page = None;
        }
        Some(value)
    }

    /// Entries alive, ascending id.
    pub fn iter(&self) -> impl Iterator<Item = (u32, &T)> {
        self.pages.iter().enumerate().filter_map(|(p, page)| page.as_ref().map(|page| (p, page))).flat_map(
            |(p, page)| {
                page.slots.iter().enumerate().filter_map(move |(s, v)| v.as_ref().map(|v| ((p * PAGE + s) as u32, v)))
            },
        )
    }

    /// Entries alive, ascending id; all of them count as changed.
    pub(super) fn iter_mut(&mut self) -> impl Iterator<Item = (u32, &mut T)> {
        self.mark_all();
        self.pages.iter_mut().enumerate().filter_map(|(p, page)| page.as_mut().map(|page| (p, page))).flat_map(
            |(p, page)| {
                page.slots
                    .iter_mut()
                    .enumerate()
                    .filter_map(move |(s, v)| v.as_mut().map(|v| ((p * PAGE + s) as u32, v)))
            },
        )
    }

    /// Removes everything; ids go on from where they were.
    pub fn clear(&mut self) {
        self.mark_all();
        for page in &mut self.pages {
            *page = None;
        }
        self.live = 0;
    }
}

/// Numbers of the bits that are set, ascending.
fn bits(word: u64) -> impl Iterator<Item = usize> {
    let mut left = word;
    std::iter::from_fn(move || {
        let bit = (left != 0).then(|| left.trailing_zeros() as usize)?;
        left &= left - 1;
        Some(bit)
    })
}

/// Ids that are marked, which they are no more.
fn taken(marks: &mut [u64]) -> Vec<u32> {
    let words = marks.iter_mut().enumerate().map(|(page, word)| (page, std::mem::take(word)));
    words.flat_map(|(page, word)| bits(word).map(move |slot| (page * PAGE + slot) as u32)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ids_ascend_and_are_never_reused() {
        let mut store = Store::default();
        let ids: Vec<u32> = (0..200).map(|i| store.insert(i * 10)).collect();
        assert_eq!(ids, (0..200).collect::<Vec<_>>());
        assert_eq!(store.remove(5), Some(50));
        assert_eq!(store.remove(5), None);
        assert_eq!(store.insert(7), 200);
        assert_eq!(store.get(5), None);
        assert_eq!(store.get(200), Some(&7));
        assert_eq!(store.get(100_000), None);
        assert_eq!(store.len(), 200);
    }

    #[test]
    fn what_has_changed_is_told_once_and_looking_is_no_change() {
        let mut store = Store::default();
        for i in 0..130 {
            store.insert(i);
        }
        assert_eq!(store.take_changed(), (0..130).collect::<Vec<_>>());
        assert!(store.get(3).is_some() && store.get_mut(400).is_none() && store.remove(400).is_none());
        assert!(store.take_changed().is_empty());
        for id in [70, 129] {
            *store.get_mut(id).unwrap() += 1;
        }
        *store.get_mut_unnoticed(5).unwrap() += 1;
        store.remove(64);
        store.restore(200, 7);
        assert_eq!(store.take_changed(), [64, 70, 129, 200]);
        assert_eq!(store.take_touched(), (0..130).chain([200]).collect::<Vec<_>>());
        store.get_mut_unnoticed(5);
        store.touch(9);
        assert_eq!((store.take_touched(), store.take_changed()), (vec![5, 9], vec![]));
        assert_eq!(store.next_id(), 201);
        assert_eq!(store.iter_mut().count(), 130);
        let alive: Vec<u32> = store.iter().map(|(id, _)| id).collect();
        assert_eq!(store.take_changed(), alive);
        store.remove(3);
        store.clear();
        assert_eq!(store.take_changed(), alive, "what was alive when it was told last");
    }

    #[test]
    fn iteration_ascends_over_what_is_alive_and_empty_pages_are_freed() {
        let mut store = Store::default();
        for i in 0..300u32 {
            store.insert(i);
        }
        for i in 64..192 {
            store.remove(i);
        }
        let ids: Vec<u32> = store
            .iter()
            .map(|(id, &v)| {
                assert_eq!(id, v);
                id
            })
            .collect();
        assert_eq!(ids, (0..64).chain(192..300).collect::<Vec<_>>());
        assert_eq!(store.ids().collect::<Vec<_>>(), ids);
        for from in [0, 5, 63, 64, 100, 192, 299, 300, 5000] {
            let after: Vec<u32> = ids.iter().copied().filter(|id| *id >= from).collect();
            assert_eq!(store.ids_from(from).collect::<Vec<_>>(), after);
            assert_eq!(store.last_before(from), ids.iter().copied().rfind(|id| *id < from));
            assert_eq!(store.contains(from), ids.contains(&from));
        }
        assert!(store.pages[1].is_none() && store.pages[2].is_none());
        store.clear();
        assert!(store.is_empty());
        assert_eq!(store.insert(1), 300);
    }
}
