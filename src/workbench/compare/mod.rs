//! Detectors and matchers compared on pairs of pictures.
