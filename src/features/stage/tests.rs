use super::*;

#[test]
fn a_first_picture_of_low_contrast_has_its_corners_at_once() {
    // Specks of 3 pixels that are 19 grey levels brighter than their surroundings, less than the usual threshold.
    let mut picture = GreyImage::new(320, 240);
    for (i, pixel) in picture.data.iter_mut().enumerate() {
        let (x, y) = (i % 320, i / 320);
        *pixel = if x % 32 / 3 == 5 && y % 32 / 3 == 5 { 139 } else { 120 };
    }
    let mut stage = FeatureStage::new(&FeaturesConfig::default());
    let mut features = FrameFeatures::default();
    stage.step_grey(&picture, &mut features);
    let first = features.tracks.len();
    for _ in 0..8 {
        stage.step_grey(&picture, &mut features);
    }
    assert!(
        first >= 40 && first * 10 >= features.tracks.len() * 9,
        "{first} at first, {} later",
        features.tracks.len()
    );
}

/// 640x480: a speck of 3 px in each of the left `columns` of 32 px, in the column n 30 + n grey levels brighter than its surroundings,
/// and in the other columns one of 2 px beside an edge of 150 grey levels.
fn specks_and_edges(columns: usize) -> GreyImage {
    let mut picture = GreyImage::new(640, 480);
    for (i, pixel) in picture.data.iter_mut().enumerate() {
        let (x, y) = (i % 640, i / 640);
        let (column, at) = (x / 32, (x % 32, y % 32));
        let bright = match at {
            (15..=17, 15..=17) if column < columns => 30 + column as u8,
            (15..=16, 12..=13) if column >= columns => 25,
            (_, 15..) if column >= columns => 150,
            _ => 0,
        };
        *pixel = 100 + bright;
    }
    picture
}

#[test]
fn weak_corners_are_followed_where_there_are_few_others_and_edges_are_not() {
    let columns_with_tracks = |columns, min_eigenvalue| {
        let config = FeaturesConfig { min_eigenvalue, ..FeaturesConfig::default() };
        let (mut stage, mut features) = (FeatureStage::new(&config), FrameFeatures::default());
        for _ in 0..2 {
            stage.step_grey(&specks_and_edges(columns), &mut features);
        }
        features.tracks.iter().map(|t| t.position.x as usize / 32).collect::<Vec<_>>()
    };
    // 15 rows of cells, but for the border. All weak: the strongest of them, until there are half as many as there may be.
    let weak = columns_with_tracks(20, 1000.0);
    assert!((150..=165).contains(&weak.len()) && weak.iter().all(|c| *c >= 9), "{weak:?}");
    // The columns from 9 on are strong, and 165 places.
    let strong = columns_with_tracks(20, 40.0);
    assert!((151..=165).contains(&strong.len()) && strong.iter().all(|c| *c >= 9), "{strong:?}");
    // Where the edges begin is a corner.
    let beside_edges = columns_with_tracks(5, 1000.0);
    assert!(beside_edges.len() > 60 && beside_edges.iter().all(|c| *c <= 5), "{beside_edges:?}");
}

#[test]
fn pictures_that_are_weak_for_a_moment_do_not_start_weak_tracks() {
    let faded = |by: u8| {
        let mut picture = specks_and_edges(20);
        picture.data.iter_mut().for_each(|grey| *grey = 100 + (*grey - 100) / by);
        picture
    };
    let mut stage = FeatureStage::new(&FeaturesConfig { min_threshold: 2.0, ..FeaturesConfig::default() });
    let mut features = FrameFeatures::default();
    let mut started = |picture: &GreyImage, frames: usize| {
        for _ in 0..frames {
            stage.step_grey(picture, &mut features);
        }
        features.tracks.len()
    };
    assert!(started(&faded(1), 30) > 250);
    let blank = GreyImage { data: vec![100; 640 * 480], ..faded(1) };
    assert_eq!(started(&blank, 1), 0);
    assert!(started(&faded(4), 5) < 20, "{} tracks at once", started(&faded(4), 0));
    let dark = started(&faded(4), 100);
    assert!((140..=170).contains(&dark), "{dark} tracks in the end");
    assert_eq!(started(&blank, 1), 0);
    assert!(started(&faded(4), 1) >= 140, "{} tracks at once: the room is still dark", started(&faded(4), 0));
}

#[test]
fn a_small_picture_has_about_as_many_cells_as_a_large_one() {
    let cells = |width, height| {
        let mut stage = FeatureStage::new(&FeaturesConfig::default());
        stage.step_grey(&GreyImage::new(width, height), &mut FrameFeatures::default());
        stage.grid.cells.len()
    };
    assert_eq!(cells(640, 480), 300, "as configured");
    assert!((240..=400).contains(&cells(414, 125)), "{}", cells(414, 125));
    assert!((240..=400).contains(&cells(320, 240)), "{}", cells(320, 240));
}
