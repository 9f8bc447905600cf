//! Keyframes, landmarks and their covisibility. Knows no threads.
