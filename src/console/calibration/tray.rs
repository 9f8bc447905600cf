//! A picture for whoever looks for a board, copied only when one is asked for: the next that pages are shown, so always the newest.

use std::sync::atomic::{AtomicBool, Ordering};

use crossbeam::channel::{Receiver, Sender, bounded};

use super::guided::Picture;

/// See module.
#[derive(Debug)]
pub struct Tray {
    /// A calibration runs: pictures are subscribed to.
    open: AtomicBool,
    /// One is asked for.
    asked: AtomicBool,
    put: Sender<Picture>,
    taken: Receiver<Picture>,
}

impl Default for Tray {
    fn default() -> Self {
        let (put, taken) = bounded(1);
        Self { open: AtomicBool::new(false), asked: AtomicBool::new(false), put, taken }
    }
}

impl Tray {
    pub fn is_open(&self) -> bool {
        self.open.load(Ordering::Relaxed)
    }

    /// Closed: nothing is asked for, and what was given is of no use.
    pub fn set_open(&self, open: bool) {
        self.open.store(open, Ordering::Relaxed);
        if !open {
            self.asked.store(false, Ordering::Release);
            let _ = self.taken.try_recv();
        }
    }

    /// For the next picture.
    pub fn ask(&self) {
        self.asked.store(true, Ordering::Release);
    }

    pub fn is_asked(&self) -> bool {
        self.asked.load(Ordering::Acquire)
    }

    /// Gives a picture if one is asked for.
    pub fn give(&self, picture: impl FnOnce() -> Picture) {
        if self.asked.swap(false, Ordering::AcqRel) {
            // One that nobody has taken is older.
            if let Err(full) = self.put.try_send(picture()) {
                let _ = self.taken.try_recv();
                let _ = self.put.try_send(full.into_inner());
            }
        }
    }

    pub fn pictures(&self) -> &Receiver<Picture> {
        &self.taken
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_picture_is_copied_only_when_asked_for_and_the_newest_stays() {
        let tray = Tray::default();
        let number = |sequence| Picture { sequence, ..Picture::default() };
        tray.give(|| unreachable!("nobody asked"));
        for n in [1, 2, 3] {
            tray.ask();
            tray.give(|| number(n));
            assert!(!tray.is_asked());
        }
        assert_eq!(tray.pictures().try_recv().map(|p| p.sequence), Ok(3));
        assert!(tray.pictures().is_empty());
        tray.ask();
        tray.give(|| number(4));
        tray.ask();
        tray.set_open(false);
        assert!(tray.pictures().is_empty(), "of the calibration before");
        tray.give(|| unreachable!("nobody asks any more"));
    }
}
