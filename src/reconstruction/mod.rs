//! From features to poses and a map. Knows no V4L2, ring or iceoryx2.
