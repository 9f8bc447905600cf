//! Paged storage by ascending ids that are never reused.
//!
//! Lookup is O(1), iteration is in ascending id (deterministic), and a page whose entries are all removed is freed, so that
//! memory follows what is alive and not what ever was: 16 bytes remain of each 64 removed ids.
//!
//! It also knows which entries have changed since that was asked last, for who keeps a copy elsewhere (a file): one bit an entry.

/// Entries of a page: as many as a word has bits.
pub const PAGE: usize = 64;

struct Page<T> {
    live: usize,
    slots: [Option<T>; PAGE],
}

/// Map from a dense, growing `u32` id to `T`.
pub struct Store<T> {
    pages: Vec<Option<Box<Page<T>>>>,
    /// A bit for each entry of a page that was put, changed or removed; may be shorter than `pages`.
    changed: Vec<u64>,
    next: u32,
    live: usize,
}

impl<T> Default for Store<T> {
    fn default() -> Self {
        Self { pages: Vec::new(), changed: Vec::new(), next: 0, live: 0 }
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
        let mut ids = Vec::new();
        for (page, word) in self.changed.iter_mut().enumerate() {
            let word = std::mem::take(word);
            ids.extend((0..PAGE).filter(|slot| word >> slot & 1 == 1).map(|slot| (page * PAGE + slot) as u32));
        }
        ids
    }

    /// Whether there are any.
    pub fn has_changed(&self) -> bool {
        self.changed.iter().any(|word| *word != 0)
    }

    fn mark(&mut self, id: u32) {
        let page = id as usize / PAGE;
        if page >= self.changed.len() {
            self.changed.resize(page + 1, 0);
        }
        self.changed[page] |= 1 << (id as usize % PAGE);
    }

    /// Those alive; what was removed before stays marked.
    fn mark_all(&mut self) {
        self.changed.resize(self.changed.len().max(self.pages.len()), 0);
        for (word, page) in self.changed.iter_mut().zip(&self.pages) {
            let slots = page.iter().flat_map(|page| page.slots.iter().enumerate());
            *word = slots.filter(|(_, v)| v.is_some()).fold(*word, |word, (s, _)| word | 1 << s);
        }
    }

    fn put(&mut self, id: u32, value: T) {
        self.mark(id);
        let (page, slot) = (id as usize / PAGE, id as usize % PAGE);
        if page >= self.pages.len() {
            self.pages.resize_with(page + 1, || None);
        }
        let page = self.pages[page].get_or_insert_with(|| Box::new(Page { live: 0, slots: [const { None }; PAGE] }));
        if page.slots[slot].replace(value).is_none() {
            page.live += 1;
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
        self.pages.get_mut(id as usize / PAGE)?.as_mut()?.slots[id as usize % PAGE].as_mut()
    }

    /// Takes the entry out.
    pub fn remove(&mut self, id: u32) -> Option<T> {
        self.get(id)?;
        self.mark(id);
        let page = self.pages.get_mut(id as usize / PAGE)?;
        let inner = page.as_mut()?;
        let value = inner.slots[id as usize % PAGE].take()?;
        inner.live -= 1;
        self.live -= 1;
        if inner.live == 0 {
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
        assert!(store.pages[1].is_none() && store.pages[2].is_none());
        store.clear();
        assert!(store.is_empty());
        assert_eq!(store.insert(1), 300);
    }
}
