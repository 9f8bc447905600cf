use std::sync::Arc;

use nalgebra::Matrix2;

use super::away::CopyFault;
use super::picture::Detail;
use super::reduction::MOST_VIEWS;
use super::*;
use crate::features::alignment::{AlignOptions, Template, align};
use crate::features::fast::FastDetector;
use crate::features::patch_sampling::warp_patch;
use crate::features::spread::Spread;
use crate::geometry::random::Random;
use crate::image::pyramid::level_from_base;
use crate::image::{GreyImage, Pyramid};
use crate::map::examples;
use crate::map::view::{DESCRIBED_LEVELS, Description, ROOM};

/// Blobs of several sizes with a camera's noise.
fn pyramid(random: &mut Random) -> Arc<Pyramid> {
    let mut image = GreyImage::new(320, 240);
    let blobs: Vec<[f64; 4]> = (0..400)
        .map(|_| [random.uniform(0.0, 320.0), random.uniform(0.0, 240.0), random.uniform(1.5, 6.0), random.normal()])
        .collect();
    for (i, v) in image.data.iter_mut().enumerate() {
        let (x, y) = ((i % 320) as f64, (i / 320) as f64);
        let near =
            |[bx, by, r, h]: &[f64; 4]| 60.0 * h * (-((x - bx).powi(2) + (y - by).powi(2)) / (2.0 * r * r)).exp();
        *v = (120.0 + blobs.iter().map(near).sum::<f64>() + 1.5 * random.normal()).clamp(0.0, 255.0) as u8;
    }
    let mut pyramid = Pyramid::new(5);
    pyramid.build(&image);
    Arc::new(pyramid)
}

fn keyframe(pyramid: &Arc<Pyramid>, x: f64) -> Keyframe {
    let pose = Se3::new(nalgebra::UnitQuaternion::identity(), Vector3::new(-x, 0.0, 0.0));
    Keyframe {
        thumbnail: crate::features::thumbnail::thumbnail_of(pyramid),
        ..examples::keyframe(pyramid.clone(), pose)
    }
}

/// Keyframes side by side before a wall at distance 2, and landmarks that some of them see.
fn map(random: &mut Random, landmarks: usize, seen_by: impl Fn(usize) -> Vec<usize>) -> (Map, Vec<KeyframeId>) {
    let pyramid = pyramid(random);
    let mut map = Map::default();
    let ids: Vec<KeyframeId> = (0..4).map(|i| map.add_keyframe(keyframe(&pyramid, 0.01 * i as f64))).collect();
    let (mut detector, mut corners) = (FastDetector::default(), Vec::new());
    detector.detect_all(&pyramid.levels[0], 8, &mut corners);
    corners.retain(|c| (25.0..295.0).contains(&c.x) && (25.0..215.0).contains(&c.y));
    let mut corners =
        Spread::default().over_cells((320, 240), 20, &mut corners).copied().collect::<Vec<_>>().into_iter();
    for n in 0..landmarks {
        let anywhere = Vector2::new(random.uniform(25.0, 295.0) as f32, random.uniform(25.0, 215.0) as f32);
        let pixel = corners.next().map_or(anywhere, |corner| Vector2::new(corner.x, corner.y));
        let observation = Observation {
            landmark: LandmarkId(0),
            pixel,
            normalised: Vector2::zeros(),
            displacement: Vector2::zeros(),
            inv_sigma_px: 1.0,
            normalised_from_pixel: Matrix2::identity(),
        };
        let landmark = examples::landmark(Vector3::new(0.0, 0.0, 2.0), ids[0]);
        let seen: Vec<_> = seen_by(n).into_iter().map(|k| (ids[k], observation)).collect();
        map.add_landmark(landmark, &seen);
    }
    (map, ids)
}

fn condense(map: &mut Map, id: KeyframeId) -> usize {
    map.condense_picture(id, &examples::lens(), |_, landmarks| Description {
        landmarks: vec![[None; DESCRIBED_LEVELS]; landmarks.len()],
        place: Vec::new(),
    })
}

#[test]
fn a_condensed_keyframe_shows_what_most_see_and_what_nothing_shows_any_more_goes() {
    let mut random = Random::new(21);
    // All of them see the first ten, the first two the next 60.
    let (mut map, ids) = map(&mut random, 70, |n| if n < 10 { vec![0, 1, 2, 3] } else { vec![0, 1] });
    let shown = |map: &Map, k: usize| {
        let k = map.keyframe(ids[k]).expect("there");
        k.observations.landmarks().filter(|l| k.picture.detail(l.0) > Detail::None).count()
    };
    assert_eq!(map.detailed().collect::<Vec<_>>(), ids);
    assert_eq!(condense(&mut map, ids[0]), 0, "the others show all of them yet");
    assert_eq!((shown(&map, 0), map.landmarks.len()), (MOST_VIEWS, 70));
    let first = &map.keyframe(ids[0]).expect("there").picture;
    assert!((0..10).all(|l| first.detail(l) == Detail::Full), "what most see comes first");
    assert!(first.is_condensed() && first.pyramid().levels[3].width == 40);
    // The second keeps those of which it shows what no other one does.
    assert_eq!(condense(&mut map, ids[1]), 60 - (MOST_VIEWS - 10) - MOST_VIEWS);
    assert_eq!((shown(&map, 1), map.landmarks.len()), (MOST_VIEWS, 10 + 2 * MOST_VIEWS - 10));
    assert_eq!(map.detailed().collect::<Vec<_>>(), ids[2..]);
    map.check_consistency().unwrap();
    // Fused with another, a landmark keeps its view; gone, it leaves none.
    let lone = LandmarkId(map.landmarks.ids().find(|l| *l >= 10 && first_shows(&map, ids[0], *l)).expect("one"));
    map.fuse(LandmarkId(0), lone);
    map.remove_landmark(LandmarkId(0));
    assert_eq!(shown(&map, 0), MOST_VIEWS - 2);
    assert!(map.keyframe(ids[0]).unwrap().picture.view(0).is_none());
    map.remove_keyframe(ids[2]);
    assert_eq!(map.detailed().collect::<Vec<_>>(), [ids[3]]);
    map.check_consistency().unwrap();
}

fn first_shows(map: &Map, id: KeyframeId, landmark: u32) -> bool {
    map.keyframe(id).is_some_and(|k| k.picture.shows(landmark))
}

#[test]
fn a_landmark_is_found_by_its_condensed_view_where_the_whole_picture_finds_it() {
    let mut random = Random::new(22);
    let (mut map, ids) = map(&mut random, MOST_VIEWS, |_| vec![0, 1]);
    let whole = map.keyframe(ids[0]).expect("there").clone();
    condense(&mut map, ids[0]);
    let condensed = map.keyframe(ids[0]).expect("there");
    let pyramid = pyramid_again(&mut random, whole.picture.pyramid());
    // A view as the keyframe's, and one of it turned by 30 degrees and 20 % nearer.
    let turned = nalgebra::Rotation2::new(0.5).into_inner() * 0.8;
    for level in [0, 1] {
        let (mut found, mut apart) = (0, Vec::new());
        for o in condensed.observations.iter() {
            let at = level_from_base(level, o.pixel);
            let place = |keyframe: &Keyframe, warp: &Matrix2<f32>| {
                let (mut room, mut pixels) = (ROOM, [0.0; 100]);
                let crop = keyframe.picture.around(level, o.landmark.0, &mut room)?;
                warp_patch(&crop, at, warp, &mut pixels).then_some(pixels)
            };
            let of = |keyframe: &Keyframe| {
                let template = Template::from_pixels(&place(keyframe, &Matrix2::identity())?);
                let start = at + Vector2::new(0.8, -0.6);
                align(&template, &pyramid.levels[level], start, &AlignOptions::default())
            };
            let Some(by_whole) = of(&whole) else { continue };
            let by_view = of(condensed).expect("found as well");
            found += 1;
            apart.push(f64::from((by_whole.position - by_view.position).norm()));
            let (a, b) = (place(&whole, &turned), place(condensed, &turned).expect("it reaches"));
            let off = a.expect("there").iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            // Half a step of the largest contrast there is, and rounding.
            assert!(off < 9.5, "a template is off by {off} grey levels");
        }
        apart.sort_unstable_by(f64::total_cmp);
        assert!(found >= MOST_VIEWS / 2, "{found}");
        // Both are found to a tenth of a pixel or so.
        println!("level {level}: {apart:?}");
        assert!(apart[apart.len() / 2] < 0.1 && apart[apart.len() * 9 / 10] < 0.4, "level {level}: {apart:?}");
    }
}

/// The same scene with other noise.
fn pyramid_again(random: &mut Random, of: &Pyramid) -> Pyramid {
    let mut image = of.levels[0].clone();
    image.data.iter_mut().for_each(|v| *v = (f64::from(*v) + 1.5 * random.normal()).clamp(0.0, 255.0) as u8);
    let mut pyramid = Pyramid::new(5);
    pyramid.build(&image);
    pyramid
}

#[test]
fn a_picture_that_was_away_comes_back_with_what_became_of_its_landmarks_meanwhile() {
    let (mut map, ids) = map(&mut Random::new(23), 40, |n| if n < 20 { vec![0, 1] } else { vec![0, 1, 2] });
    condense(&mut map, ids[0]);
    let copied = |picture: &KeyframePicture| examples::copied(picture, 0);
    let own = |map: &Map| map.keyframe(ids[0]).expect("there").picture.clone();
    let before = own(&map);
    let shown: Vec<u32> = before.views().iter().map(|v| v.landmark).collect();
    assert_eq!(map.condensed_here().collect::<Vec<_>>(), [ids[0]]);
    assert!(map.put_picture_away(ids[0], copied) && !map.put_picture_away(ids[0], copied));
    assert!(!map.put_picture_away(ids[3], copied), "it is whole");
    assert_eq!(map.condensed_here().len(), 0);
    let away = own(&map);
    assert!(away.is_away() && away.is_condensed() && away.levels() == 0 && away.bytes() < 1000, "{}", away.bytes());
    assert!((0..40).all(|l| away.detail(l) == before.detail(l)), "what it shows is known");
    assert_eq!(away.revision(), before.revision(), "a file need not be told");
    let mut alone = away.clone();
    alone.bring_back().expect("read");
    assert_eq!(alone.views(), before.views(), "also in a copy of the keyframe");

    // One is forgotten, one turns out to be another.
    let [gone, other] = [shown[3], shown[9]];
    map.remove_landmark(LandmarkId(gone));
    let new = map.add_landmark(
        examples::landmark(Vector3::z(), ids[3]),
        &[(ids[3], map.keyframe(ids[1]).expect("there").observation(LandmarkId(0)).expect("seen"))],
    );
    map.fuse(new, LandmarkId(other));
    assert_eq!(map.bring_picture_back(ids[0]), Ok(true));
    assert_eq!(map.bring_picture_back(ids[0]), Ok(false));
    let back = own(&map);
    let renamed = |l: u32| if l == other { new.0 } else { l };
    let expected: Vec<u32> = shown.iter().filter(|l| **l != gone).map(|l| renamed(*l)).collect();
    let mut views: Vec<u32> = back.views().iter().map(|v| v.landmark).collect();
    assert!(views.is_sorted());
    assert_eq!(back.view(new.0).map(|v| &v.patches), before.view(other).map(|v| &v.patches));
    views.sort_unstable_by_key(|l| if *l == new.0 { other } else { *l });
    assert_eq!(views, expected);
    assert!(back.has_level(3) && map.condensed_here().len() == 1);
    map.check_consistency().expect("consistent");

    // Forgetting alone needs no other copy; a renamed one has another.
    assert!(map.put_picture_away(ids[0], copied) && map.bring_picture_back(ids[0]) == Ok(true));
    map.remove_landmark(LandmarkId(shown[0]));
    assert!(map.put_picture_away(ids[0], |_| unreachable!("the copy is as good")));
    assert_eq!(map.bring_picture_back(ids[0]), Ok(true));
    assert!(own(&map).view(shown[0]).is_none() && own(&map).views().len() == expected.len() - 1);
}

#[test]
fn a_picture_that_cannot_be_read_now_stays_away_and_one_whose_copy_is_spoiled_is_gone_with_what_it_alone_showed() {
    let (mut map, ids) = map(&mut Random::new(24), 40, |n| if n < 20 { vec![0, 1] } else { vec![0, 3] });
    condense(&mut map, ids[0]);
    condense(&mut map, ids[1]);
    let before = map.landmarks.len();
    let views = map.keyframe(ids[0]).expect("there").picture.views().to_vec();
    map.take_changed();
    assert!(map.put_picture_away(ids[0], |picture| examples::copied(picture, 2)));
    for _ in 0..2 {
        assert_eq!(map.bring_picture_back(ids[0]), Err(CopyFault::NotRead("a bad block".into())));
        let first = &map.keyframe(ids[0]).expect("there").picture;
        assert!(first.is_away() && !first.is_lost() && views.iter().all(|v| first.detail(v.landmark) > Detail::None));
        assert_eq!((map.landmarks.len(), map.away(), map.condensed_here().count()), (before, 1, 1));
    }
    assert_eq!(map.bring_picture_back(ids[0]), Ok(true));
    assert_eq!(map.keyframe(ids[0]).expect("there").picture.views(), views);
    assert!(!map.has_changed(), "no file needs to be told");

    // The copy would be as good as it was: another one is made once something has another name.
    let shown = views[0].landmark;
    let seen = map.keyframe(ids[3]).expect("there").observations.landmarks().next().expect("one");
    let observation = map.keyframe(ids[3]).expect("there").observation(seen).expect("seen");
    let new = map.add_landmark(examples::landmark(Vector3::z(), ids[3]), &[(ids[3], observation)]);
    map.fuse(new, LandmarkId(shown));
    let before = map.landmarks.len();
    let bad = |_: &KeyframePicture| examples::copied(&KeyframePicture::default(), 0);
    let revision = map.keyframe(ids[0]).expect("there").picture.revision();
    assert!(map.put_picture_away(ids[0], bad));
    assert_eq!(map.bring_picture_back(ids[0]), Err(CopyFault::Senseless("no picture".into())));
    let first = &map.keyframe(ids[0]).expect("there").picture;
    assert!(first.is_lost() && !first.is_away() && !first.can_be_away() && first.is_condensed());
    assert_eq!((first.revision(), map.away(), map.condensed_here().count()), (revision, 0, 1));
    assert!(map.landmarks.len() < before, "{before}");
    let renamed = |l: u32| if l == shown { new } else { LandmarkId(l) };
    assert!((20..40).all(|l| map.landmark(renamed(l)).is_some()), "the whole one shows these");
    map.check_consistency().expect("consistent");
    assert!(!map.put_picture_away(ids[0], bad) && map.bring_picture_back(ids[0]) == Ok(false));
}
