//! Which corner of one picture is which of another: by binary descriptors.
