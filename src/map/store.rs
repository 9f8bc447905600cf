//! Paged storage by ascending ids that are never reused.
//!
//! Lookup is O(1), iteration is in ascending id (deterministic), and a page holds only the entries that are alive, one behind the other, so that
//! memory follows these and not what ever was (of four landmarks of an old part of a map three have gone): 48 bytes remain of each 64 removed ids.
//!
//! It also knows which entries have changed since that was asked last, for who keeps a copy elsewhere (a file), and which were touched at all, for
//! who judges them: a bit an entry each.

/// Entries of a page: as many as a word has bits.
pub const PAGE: usize = 64;

struct Page<T> {
    /// Slots that are alive, a bit each: who asks which ids there are need not look at the entries.
    alive: u64,
    /// Their entries, ascending.
    entries: Vec<T>,
}

impl<T> Page<T> {
    fn is_alive(&self, slot: usize) -> bool {
        self.alive >> slot & 1 == 1
    }

    /// Where the entry of a slot is, or would be.
    fn rank(&self, slot: usize) -> usize {
        (self.alive & !(u64::MAX << slot)).count_ones() as usize
    }
}

/// Map from a dense, growing `u32` id to `T`.
pub struct Store<T> {
    pages: Vec<Page<T>>,
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
            for (slot, value) in bits(page.alive).zip(page.entries) {
                self.put((p * PAGE + slot) as u32, value);
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

    fn touch(&mut self, id: u32) {
        if let Some(word) = self.touched.get_mut(id as usize / PAGE) {
            *word |= 1 << (id as usize % PAGE);
        }
    }

    /// Whether the entry is alive.
    pub fn contains(&self, id: u32) -> bool {
        self.pages.get(id as usize / PAGE).is_some_and(|page| page.is_alive(id as usize % PAGE))
    }

    /// Ids of the entries that are alive, ascending.
    pub fn ids(&self) -> impl Iterator<Item = u32> {
        self.ids_from(0)
    }

    /// The same from this one on.
    pub fn ids_from(&self, first: u32) -> impl Iterator<Item = u32> {
        let (page, slot) = (first as usize / PAGE, first as usize % PAGE);
        let alive = |p: usize| self.pages[p].alive;
        let words =
            (page..self.pages.len()).map(move |p| (p, if p == page { alive(p) & u64::MAX << slot } else { alive(p) }));
        words.flat_map(|(p, word)| bits(word).map(move |slot| (p * PAGE + slot) as u32))
    }

    /// The entry alive whose id is the largest below this one.
    pub fn last_before(&self, id: u32) -> Option<u32> {
        let (page, slot) = (id as usize / PAGE, id as usize % PAGE);
        (0..self.pages.len().min(page + 1)).rev().find_map(|p| {
            let alive = self.pages[p].alive;
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
            marks.iter_mut().zip(&self.pages).for_each(|(word, page)| *word |= page.alive);
        }
    }

    fn put(&mut self, id: u32, value: T) {
        self.mark(id);
        let (page, slot) = (id as usize / PAGE, id as usize % PAGE);
        if page >= self.pages.len() {
            self.pages.resize_with(page + 1, || Page { alive: 0, entries: Vec::new() });
        }
        let page = &mut self.pages[page];
        let rank = page.rank(slot);
        match page.is_alive(slot) {
            true => page.entries[rank] = value,
            false => {
                page.entries.insert(rank, value);
                page.alive |= 1 << slot;
                self.live += 1;
            }
        }
    }

    /// The entry, if it is alive.
    pub fn get(&self, id: u32) -> Option<&T> {
        let (page, slot) = (self.pages.get(id as usize / PAGE)?, id as usize % PAGE);
        page.is_alive(slot).then(|| &page.entries[page.rank(slot)])
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
        let (page, slot) = (self.pages.get_mut(id as usize / PAGE)?, id as usize % PAGE);
        let rank = page.rank(slot);
        page.is_alive(slot).then(|| &mut page.entries[rank])
    }

    /// Takes the entry out.
    pub fn remove(&mut self, id: u32) -> Option<T> {
        self.get(id)?;
        self.mark(id);
        let (page, slot) = (self.pages.get_mut(id as usize / PAGE)?, id as usize % PAGE);
        let value = page.entries.remove(page.rank(slot));
        page.alive &= !(1 << slot);
        self.live -= 1;
        if page.entries.capacity() >= 2 * page.entries.len() {
            page.entries.shrink_to_fit();
        }
        Some(value)
    }

    /// Entries alive, ascending id.
    pub fn iter<'a>(&'a self) -> impl Iterator<Item = (u32, &'a T)>
    where
        T: 'a,
    {
        let entries = |(p, page): (usize, &'a Page<T>)| {
            bits(page.alive).zip(&page.entries).map(move |(slot, v)| ((p * PAGE + slot) as u32, v))
        };
        self.pages.iter().enumerate().flat_map(entries)
    }

    /// Entries alive, ascending id; all of them count as changed.
    pub(super) fn iter_mut<'a>(&'a mut self) -> impl Iterator<Item = (u32, &'a mut T)>
    where
        T: 'a,
    {
        self.mark_all();
        let entries = |(p, page): (usize, &'a mut Page<T>)| {
            bits(page.alive).zip(&mut page.entries).map(move |(slot, v)| ((p * PAGE + slot) as u32, v))
        };
        self.pages.iter_mut().enumerate().flat_map(entries)
    }

    /// Removes everything; ids go on from where they were.
    pub fn clear(&mut self) {
        self.mark_all();
        for page in &mut self.pages {
            *page = Page { alive: 0, entries: Vec::new() };
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
        assert_eq!((store.take_touched(), store.take_changed()), (vec![5], vec![]));
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
        assert!(store.pages[1..3].iter().all(|page| page.entries.capacity() == 0));
        store.clear();
        assert!(store.is_empty());
        assert_eq!(store.insert(1), 300);
    }
}
