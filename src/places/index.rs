//! Which keyframes show what this picture shows: an index over binary descriptors that learns its words while it runs.
//!
//! Input: the 256-bit descriptors of a keyframe's corners, at most [`DESCRIPTORS`]. Output: keyframes, the likeliest first. Nothing is shipped
//! with it and nothing is trained beforehand: a binary tree whose leaves hold descriptors and whose inner nodes each ask for one bit
//! (the idea of HBST: Schlegel & Grisetti, IEEE RA-L 2018). A leaf that is full is split by the bit that parts it evenly while parting the
//! fewest pairs of nearly equal descriptors, which are one corner seen twice: so the bits that noise turns over decide late or never. A query
//! goes down each descriptor's own way and, from each node on it, once into the other half, so that a single wrong bit hides nothing.
//! Each descriptor gives every keyframe that it is found in one vote, which weighs less the more keyframes these are.
//!
//! A query ranks and does not decide: who asks verifies by geometry.
//!
//! Cost: grows with the depth of the tree, thus with the logarithm of the number of keyframes, and voting with how often a corner
//! was seen. Memory: 36 bytes a descriptor, and half of that of leaves that are not full; `bytes` counts. Deterministic: the same
//! calls give the same answers, on every machine. Bounded: a leaf of equal descriptors that no bit parts keeps the newest [`CROWDED`] and counts the
//! others; how many keyframes there are is for the caller to bound, by [`remove`](PlaceIndex::remove).
//! It deliberately does not do: geometry, covisibility, files.

use std::collections::BTreeMap;

use crate::features::descriptor::{BITS, Descriptor};
use crate::features::matching::all_within;
use crate::map::KeyframeId;

/// Descriptors of a keyframe that are kept; those beyond are ignored, so give the best first.
pub const DESCRIPTORS: usize = 128;
/// Descriptors that a leaf holds before it is split.
const LEAF: usize = 64;
/// Descriptors that a leaf holds at the most where no bit parts them.
pub const CROWDED: usize = 256;
/// Places by which a leaf grows, so that little of its memory is unused.
const GROWTH: usize = 8;
/// One corner in two views differs by at most so many of the 256 bits, for votes. Of a corner seen again in another picture a tenth of
/// the bits have turned over, of another corner half.
const SAME_BITS: u32 = 52;
/// A split puts at least one in so many to either side.
const EVEN_ENOUGH: u32 = 5;
/// Nodes that one removal looks through for what was removed before.
const SWEPT: usize = 256;

/// A keyframe that a query found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Candidate {
    pub keyframe: KeyframeId,
    /// Weights of its votes: a descriptor that only it has gives ln(1 + keyframes).
    pub score: f32,
    /// Descriptors of the query that it has.
    pub votes: u32,
}

#[derive(Debug)]
enum Node {
    /// Which bit decides, and where it leads clear and set.
    Inner {
        bit: u16,
        children: [u32; 2],
    },
    Leaf(Leaf),
}

/// Descriptors that came the same way, and whose they are.
#[derive(Debug, Default)]
struct Leaf {
    descriptors: Vec<Descriptor>,
    slots: Vec<u32>,
    /// It is not tried to split below this, as that has failed.
    split_at: usize,
}

/// What the leaves mean by a number: numbers are used again, a keyframe's are not.
#[derive(Debug, Default)]
struct Slot {
    /// `None` once removed; what is left of it in leaves is cleared away over time.
    keyframe: Option<KeyframeId>,
    entries: u32,
    /// Of the query that counts.
    score: f32,
    votes: u32,
    /// Number of the last descriptor of a query that found it.
    asked: u64,
}

/// See the module.
#[derive(Debug)]
pub struct PlaceIndex {
    /// The first is the root.
    nodes: Vec<Node>,
    slots: Vec<Slot>,
    unused: Vec<u32>,
    slot_of: BTreeMap<KeyframeId, u32>,
    /// Entries of keyframes that were removed, and where the sweep for them goes on.
    dead: usize,
    swept: usize,
    crowded_out: u64,
    /// Descriptors asked for since the start.
    asked: u64,
    near: Vec<u32>,
    found: Vec<u32>,
    voted: Vec<u32>,
}

impl Default for PlaceIndex {
    fn default() -> Self {
        Self {
            nodes: vec![Node::Leaf(Leaf::default())],
            slots: Vec::new(),
            unused: Vec::new(),
            slot_of: BTreeMap::new(),
            dead: 0,
            swept: 0,
            crowded_out: 0,
            asked: 0,
            near: Vec::new(),
            found: Vec::new(),
            voted: Vec::new(),
        }
    }
}

impl PlaceIndex {
    /// Keyframes in it.
    pub fn len(&self) -> usize {
        self.slot_of.len()
    }

    pub fn is_empty(&self) -> bool {
        self.slot_of.is_empty()
    }

    pub fn contains(&self, keyframe: KeyframeId) -> bool {
        self.slot_of.contains_key(&keyframe)
    }

    /// Keyframes in it, ascending.
    pub fn keyframes(&self) -> impl Iterator<Item = KeyframeId> {
        self.slot_of.keys().copied()
    }

    /// Descriptors that gave way to newer ones which no bit parts from them.
    pub fn crowded_out(&self) -> u64 {
        self.crowded_out
    }

    /// Memory on the heap, bytes, without what the allocator adds.
    pub fn bytes(&self) -> usize {
        let leaf = |node: &Node| match node {
            Node::Leaf(leaf) => leaf.descriptors.capacity() * size_of::<Descriptor>() + leaf.slots.capacity() * 4,
            Node::Inner { .. } => 0,
        };
        let pairs = self.slot_of.len() * (size_of::<KeyframeId>() + size_of::<u32>());
        self.nodes.capacity() * size_of::<Node>()
            + self.nodes.iter().map(leaf).sum::<usize>()
            + self.slots.capacity() * size_of::<Slot>()
            + pairs
    }

    /// Enters a keyframe; one that is there already stays as it was.
    pub fn add(&mut self, keyframe: KeyframeId, descriptors: &[Descriptor]) {
        if self.contains(keyframe) {
            return;
        }
        let slot = self.unused.pop().unwrap_or_else(|| {
            self.slots.push(Slot::default());
            (self.slots.len() - 1) as u32
        });
        self.slots[slot as usize].keyframe = Some(keyframe);
        self.slot_of.insert(keyframe, slot);
        for descriptor in descriptors.iter().take(DESCRIPTORS) {
            self.insert(descriptor, slot);
        }
    }

    /// A keyframe that is in it is known by these alone from now on.
    pub fn replace(&mut self, keyframe: KeyframeId, descriptors: &[Descriptor]) {
        if self.contains(keyframe) {
            self.remove(keyframe);
            self.add(keyframe, descriptors);
        }
    }

    /// Takes a keyframe out: no query finds it any more, and its memory is freed by the removals and insertions that follow.
    pub fn remove(&mut self, keyframe: KeyframeId) {
        let Some(slot) = self.slot_of.remove(&keyframe) else { return };
        let entry = &mut self.slots[slot as usize];
        entry.keyframe = None;
        self.dead += entry.entries as usize;
        if entry.entries == 0 {
            self.unused.push(slot);
        }
        for _ in 0..SWEPT.min(self.nodes.len()) {
            if self.dead == 0 {
                break;
            }
            self.swept = (self.swept + 1) % self.nodes.len();
            self.clear_away(self.swept);
        }
    }

    /// The keyframes most like this picture among those that are `eligible`, the likeliest first (ties: the older), into `out`.
    pub fn query(
        &mut self,
        descriptors: &[Descriptor],
        limit: usize,
        eligible: impl Fn(KeyframeId) -> bool,
        out: &mut Vec<Candidate>,
    ) {
        out.clear();
        let total = self.slot_of.len() as f32;
        for descriptor in descriptors.iter().take(DESCRIPTORS) {
            self.asked += 1;
            self.find(descriptor);
            let weight = (total / self.found.len().max(1) as f32).ln_1p();
            for &slot in &self.found {
                let slot_entry = &mut self.slots[slot as usize];
                if slot_entry.votes == 0 {
                    self.voted.push(slot);
                }
                slot_entry.votes += 1;
                slot_entry.score += weight;
            }
        }
        for slot in self.voted.drain(..) {
            let Slot { keyframe, score, votes, .. } = &mut self.slots[slot as usize];
            let (score, votes) = (std::mem::take(score), std::mem::take(votes));
            let eligible = keyframe.filter(|id| eligible(*id));
            out.extend(eligible.map(|keyframe| Candidate { keyframe, score, votes }));
        }
        out.sort_unstable_by(|a, b| b.score.total_cmp(&a.score).then(a.keyframe.cmp(&b.keyframe)));
        out.truncate(limit);
    }

    /// Slots of the keyframes that have a descriptor, each once, into `found`.
    fn find(&mut self, descriptor: &Descriptor) {
        self.found.clear();
        let mut at = 0;
        while let Node::Inner { bit, children } = self.nodes[at] {
            let own = usize::from(has(descriptor, bit));
            self.visit(self.leaf_of(descriptor, children[1 - own] as usize), descriptor);
            at = children[own] as usize;
        }
        self.visit(at, descriptor);
    }

    /// The leaf that a descriptor belongs to, from a node on. Ends, as children are always younger than their parent.
    fn leaf_of(&self, descriptor: &Descriptor, mut at: usize) -> usize {
        while let Node::Inner { bit, children } = self.nodes[at] {
            at = children[usize::from(has(descriptor, bit))] as usize;
        }
        at
    }

    fn visit(&mut self, leaf: usize, descriptor: &Descriptor) {
        let Node::Leaf(leaf) = &self.nodes[leaf] else { return };
        all_within(descriptor, &leaf.descriptors, SAME_BITS, &mut self.near);
        for &i in &self.near {
            let slot = leaf.slots[i as usize];
            let entry = &mut self.slots[slot as usize];
            if entry.keyframe.is_some() && entry.asked != self.asked {
                entry.asked = self.asked;
                self.found.push(slot);
            }
        }
    }

    fn insert(&mut self, descriptor: &Descriptor, slot: u32) {
        let at = self.leaf_of(descriptor, 0);
        let full = |node: &Node| matches!(node, Node::Leaf(leaf) if leaf.descriptors.len() >= LEAF);
        if full(&self.nodes[at]) && self.dead > 0 {
            self.clear_away(at);
        }
        let Node::Leaf(leaf) = &mut self.nodes[at] else { return };
        if leaf.descriptors.len() >= CROWDED {
            // The oldest, as entries keep their order.
            leaf.descriptors.remove(0);
            let gone = leaf.slots.remove(0);
            self.crowded_out += 1;
            self.forget_entry(gone);
        }
        let Node::Leaf(leaf) = &mut self.nodes[at] else { return };
        if leaf.descriptors.len() == leaf.descriptors.capacity() {
            leaf.descriptors.reserve_exact(GROWTH);
            leaf.slots.reserve_exact(GROWTH);
        }
        leaf.descriptors.push(*descriptor);
        leaf.slots.push(slot);
        self.slots[slot as usize].entries += 1;
        self.split(at);
    }

    /// Splits a leaf that holds too much, if a bit parts it.
    fn split(&mut self, at: usize) {
        let next = self.nodes.len() as u32;
        let Node::Leaf(leaf) = &mut self.nodes[at] else { return };
        if leaf.descriptors.len() <= LEAF.max(leaf.split_at) {
            return;
        }
        let Some(bit) = dividing_bit(&leaf.descriptors) else {
            leaf.split_at = leaf.descriptors.len() + LEAF;
            return;
        };
        let set = leaf.descriptors.iter().filter(|d| has(d, bit)).count();
        let mut halves = [leaf.descriptors.len() - set, set].map(|n| Leaf {
            descriptors: Vec::with_capacity(n + GROWTH),
            slots: Vec::with_capacity(n + GROWTH),
            split_at: 0,
        });
        for (descriptor, slot) in leaf.descriptors.iter().zip(&leaf.slots) {
            let half = &mut halves[usize::from(has(descriptor, bit))];
            half.descriptors.push(*descriptor);
            half.slots.push(*slot);
        }
        self.nodes[at] = Node::Inner { bit, children: [next, next + 1] };
        self.nodes.extend(halves.map(Node::Leaf));
    }

    /// Drops what a leaf still holds of keyframes that were removed.
    fn clear_away(&mut self, node: usize) {
        let Node::Leaf(leaf) = &mut self.nodes[node] else { return };
        let mut gone = Vec::new();
        let mut kept = 0;
        for i in 0..leaf.slots.len() {
            if self.slots[leaf.slots[i] as usize].keyframe.is_none() {
                gone.push(leaf.slots[i]);
                continue;
            }
            leaf.slots[kept] = leaf.slots[i];
            leaf.descriptors[kept] = leaf.descriptors[i];
            kept += 1;
        }
        leaf.slots.truncate(kept);
        leaf.descriptors.truncate(kept);
        if leaf.slots.capacity() > kept + 4 * GROWTH {
            leaf.slots.shrink_to(kept + GROWTH);
            leaf.descriptors.shrink_to(kept + GROWTH);
        }
        for slot in gone {
            self.forget_entry(slot);
        }
    }

    /// One entry less of a slot, which is free for another keyframe once it has none and is nobody's.
    fn forget_entry(&mut self, slot: u32) {
        let entry = &mut self.slots[slot as usize];
        entry.entries -= 1;
        if entry.keyframe.is_none() {
            self.dead -= 1;
            if entry.entries == 0 {
                self.unused.push(slot);
            }
        }
    }
}

#[inline]
fn has(descriptor: &Descriptor, bit: u16) -> bool {
    descriptor.0[usize::from(bit) / 64] >> (bit % 64) & 1 == 1
}

/// The bit that parts descriptors best: of those that part them evenly enough the one that tears apart the fewest pairs of nearly equal ones,
/// against the pairs that it parts in all. `None` where every bit is (nearly) the same in all.
fn dividing_bit(descriptors: &[Descriptor]) -> Option<u16> {
    let (mut set, mut torn) = ([0u32; BITS as usize], [0u32; BITS as usize]);
    let count = |bits: &Descriptor, into: &mut [u32; BITS as usize]| {
        for (word, mut left) in bits.0.iter().copied().enumerate() {
            while left != 0 {
                into[word * 64 + left.trailing_zeros() as usize] += 1;
                left &= left - 1;
            }
        }
    };
    let mut near = Vec::new();
    for (i, descriptor) in descriptors.iter().enumerate() {
        count(descriptor, &mut set);
        all_within(descriptor, &descriptors[..i], SAME_BITS, &mut near);
        for &j in &near {
            let other = &descriptors[j as usize];
            count(&Descriptor(std::array::from_fn(|k| descriptor.0[k] ^ other.0[k])), &mut torn);
        }
    }
    let n = descriptors.len() as u32;
    let even = |bit: &u16| EVEN_ENOUGH * set[usize::from(*bit)].min(n - set[usize::from(*bit)]) >= n;
    // Exact in whole numbers: torn / parted, compared crosswise; the half keeps evenness in the scale where nothing is torn.
    let cost = |bit: u16| {
        let (set, torn) = (u64::from(set[usize::from(bit)]), u64::from(torn[usize::from(bit)]));
        (2 * torn + 1, set * (u64::from(n) - set))
    };
    (0..BITS as u16).filter(even).min_by(|&a, &b| {
        let ((torn_a, parted_a), (torn_b, parted_b)) = (cost(a), cost(b));
        (torn_a * parted_b).cmp(&(torn_b * parted_a))
    })
}

#[cfg(test)]
mod tests;
