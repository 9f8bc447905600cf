//! Map-free work on one picture: corners, descriptors, frame-to-frame tracks.
