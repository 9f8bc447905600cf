//! `cairn watch` as a process.
