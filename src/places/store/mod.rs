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
//!   landmarks PAGE       64 ids a page                                               whenever one has changed
//! ```
//!
//! **Before anything is written** to a file that exists it is read in full through a copy that forgets (`backend`): front page, the
//! database's own checksums, those of all records, their number, and whether they make maps. A file that is foreign, newer, cut off or broken is
//! refused with what is wrong, and stays as it is to the byte; the library's panics are errors like any other.
//!
//! **Size**: of a 640 x 480 picture some 65 kB a keyframe, 45 of them the half-resolution level without loss, and 130 bytes a landmark.
//! Time of a write: 10 ms and some 5 ms a new keyframe, on whichever thread calls.
//!
//! Deliberately not here: threads and clocks that decide (the daemon's), parts of a map (a file is loaded in full), other programs' formats
//! (the room `map` has those).

mod backend;
mod error;
mod file;
mod front;
mod layout;
mod picture;
mod records;
#[cfg(test)]
mod tests;

pub use error::{Fault, StoreError};
pub use file::{Contents, MapFile, read};
