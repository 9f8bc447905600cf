//! What a session does whatever is calibrated; the real calibration is tried by `cli`, which knows it.

use super::*;
use crate::console::calibration::guided::{Lens, Look};

/// Takes each picture, is solved with the third, and done with the fifth. Panics over a picture one pixel wide.
#[derive(Debug)]
struct Counting(usize);

#[derive(Debug)]
struct Counter;

impl Calibrator for Counter {
    fn begin(&self, board: &Board) -> Result<Box<dyn Guided>, String> {
        if board.columns < 3 { Err("too small".into()) } else { Ok(Box::new(Counting(0))) }
    }
}

impl Guided for Counting {
    fn look(&mut self, picture: Picture) -> Glance {
        self.0 += 1;
        assert!(picture.width > 1, "too narrow");
        let size = [picture.width, picture.height];
        Glance { sequence: picture.sequence, size, look: Look::Taken, advice: "go on".into(), corners: Vec::new() }
    }
    fn guidance(&self) -> Guidance {
        Guidance { views: self.0, solved: self.0 >= 3, ..Guidance::default() }
    }
    fn is_done(&self) -> bool {
        self.0 >= 5
    }
    fn outcome(&self) -> Option<Outcome> {
        let (file, file_name) = ("fx_px = 500".to_owned(), "camera.toml".to_owned());
        (self.0 >= 3).then_some(Outcome { values: Vec::new(), good: true, words: Vec::new(), file, file_name })
    }
}

struct Table {
    session: Session,
    now: Instant,
}

impl Table {
    fn new() -> Self {
        Self { session: Session::new(Arc::new(Counter)), now: Instant::now() }
    }

    fn start(&mut self, id: u32) -> Result<String, String> {
        let board = Board { columns: 9, rows: 6, square_m: None, lens: Lens::Full };
        self.obey(Action::Start { board }, id)
    }

    fn obey(&mut self, action: Action, id: u32) -> Result<String, String> {
        self.session.obey(action, id, self.now, &|file| Ok(format!("kept: {file}")))
    }

    fn look(&mut self, run_id: u64) {
        self.now += Duration::from_millis(100);
        let picture = Picture { run_id, width: 2, height: 2, pixels: vec![0; 4], ..Picture::default() };
        self.session.look(picture);
        self.session.wait(self.now);
    }

    fn phase(&self) -> &'static str {
        self.session.told(self.now).phase
    }
}

#[test]
fn one_runs_at_a_time_whichever_page_began_it_and_any_page_may_end_it() {
    let mut table = Table::new();
    assert_eq!(table.phase(), "idle");
    table.start(10).expect("the first page's");
    table.look(1);
    let error = table.start(20).expect_err("the second page's");
    assert!(error.contains("under way (1 views of a board of 9x6)"), "{error}");
    assert_eq!((table.session.told(table.now).by, table.session.told(table.now).run), (10, 1));
    table.obey(Action::Cancel {}, 21).expect("cancelled");
    assert_eq!(table.phase(), "idle");
    table.look(1);
    assert_eq!(table.phase(), "idle", "a late picture begins nothing");
    table.start(22).expect("the second page's, now");
    let told = table.session.told(table.now);
    assert_eq!((told.phase, told.by, told.run), ("running", 22, 2));
    assert_eq!(told.guidance.map(|g| g.views), Some(0), "nothing is left of the one before");
}

#[test]
fn it_ends_with_the_last_view_or_with_what_there_is_and_another_can_begin() {
    let mut table = Table::new();
    table.start(1).expect("started");
    for _ in 0..5 {
        assert_eq!(table.phase(), "running");
        table.look(1);
    }
    assert_eq!(table.phase(), "done");
    assert!(table.obey(Action::Finish {}, 2).is_err(), "it is over");
    assert!(table.obey(Action::Save {}, 2).is_err(), "nobody knows the camera");
    table.start(3).expect("an outcome holds nobody up");
    assert_eq!(table.session.nameless(), None, "no picture, no daemon");
    table.look(1);
    assert_eq!(table.session.nameless(), Some(1));
    table.session.name(Some(Camera { identity: "046d:0825".into(), device: "/dev/video0".into() }));
    assert_eq!(table.session.nameless(), None);
    assert!(table.obey(Action::Finish {}, 4).is_err_and(|e| e.contains("too few")));
    table.look(1);
    table.look(1);
    table.obey(Action::Finish {}, 5).expect("three are enough");
    assert_eq!(table.obey(Action::Save {}, 6).as_deref(), Ok("kept: fx_px = 500"));
    assert_eq!(table.session.told(table.now).saved, Some("kept: fx_px = 500"));
}

#[test]
fn silence_another_daemon_and_odd_pictures_end_it_with_a_reason() {
    let ends = |table: &Table, reason: &str| {
        let told = table.session.told(table.now);
        assert!(told.phase == "failed" && told.sentence.contains(reason), "{} {}", told.phase, told.sentence);
    };
    let mut table = Table::new();
    table.start(1).expect("started");
    table.now += SILENCE - Duration::from_millis(1);
    assert!(!table.session.turn(table.now));
    table.now += Duration::from_secs(1);
    assert!(table.session.turn(table.now) && !table.session.turn(table.now), "told once");
    ends(&table, "no picture for 10 s");

    table.start(2).expect("again");
    table.look(1);
    table.look(2);
    ends(&table, "started anew");

    table.start(3).expect("again");
    let picture = Picture { width: 4000, height: 4000, ..Picture::default() };
    table.session.look(picture);
    ends(&table, "4000x4000 px");

    // Pictures come all the time, and the time is over: with too few of them, and with enough.
    for (views, phase) in [(2, "failed"), (4, "done")] {
        table.start(4).expect("again");
        let end = table.now + LIMIT;
        for n in 1..=views {
            table.now = if n < views { table.now } else { end };
            table.look(1);
        }
        assert!(table.session.turn(table.now));
        assert_eq!(table.phase(), phase, "{views} views");
        assert!(table.session.told(table.now).sentence.starts_with("the time is over"));
    }
}

#[test]
fn a_panic_ends_the_calibration_that_it_is_in_and_no_other() {
    let mut table = Table::new();
    table.start(1).expect("started");
    let narrow = Picture { width: 1, height: 1, pixels: vec![0], ..Picture::default() };
    assert!(table.session.guarded(|session| session.look(narrow)).is_err());
    let told = table.session.told(table.now);
    assert!(told.phase == "failed" && told.sentence.contains("too narrow"), "{} {}", told.phase, told.sentence);
    table.start(2).expect("another one");
    table.look(1);
    assert_eq!(table.phase(), "running");
}
