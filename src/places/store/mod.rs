//! Maps on disk: one file a map, whole after a power cut, continued by the next run.
//!
//! In: what reconstruction tells of its maps every few seconds ([`MapChanges`](crate::map::saved::MapChanges)). Out: the same maps, with the
//! same ids and the same floats, in another process ([`SavedMaps`](crate::map::saved::SavedMaps)).
//!
//! ```text
//! front page (`front`)   magic, version of the format, id, checksum                  written once
//! database (`redb`)      a table of records, each with its checksum (`records`)      one transaction a write
//!   header               camera and lens, maps with the ids of their keyframes, number and sum of all records
//!   keyframe ID          pose, observations, free corners (`layout`)                 whenever it has changed
//!   picture ID           finest level and patches, as PNG (`picture`)                twice: whole, and reduced
//!   condensed ID         instead of it: coarse level and views (`picture`)           once
//!   landmarks PAGE       64 ids a page                                               whenever one has changed
//! ```
//!
//! **Before anything is written** to a file that exists it is read in full through a copy that forgets (`backend`): front page, the
//! database's own checksums, those of all records, their number, and whether they make maps. A file that is foreign, newer, cut off or broken is
//! refused with what is wrong, and stays as it is to the byte; the library's panics are errors like any other.
//!
//! **Size**: of 640 x 480 pictures some 90 kB a keyframe with all that belongs to it (tum_fr1_desk: 193 keyframes, 17.8 MB), 70 of them
//! pictures without loss, 8 observations and 4 landmarks. Time: 1 ms a frame on average while mapping, on whichever thread calls.
//!
//! Deliberately not here: threads and clocks that decide (the daemon's), parts of a map (a file is loaded in full), other programs' formats
//! (the room `map` has those).

mod backend;
#[cfg(test)]
mod condensed_tests;
#[cfg(test)]
mod edition_tests;
mod error;
mod file;
mod front;
mod layout;
mod naming;
pub(super) mod picture;
mod records;
#[cfg(test)]
mod tests;

pub use error::{Fault, StoreError};
pub use file::{Contents, Edition, MapFile, adopt, read, read_to_locate};
pub use layout::MOST_IDS;
