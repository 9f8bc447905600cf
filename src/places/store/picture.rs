//! A keyframe's picture as a record: nothing is lost.
//!
//! The finest level there is, and the patches of a reduced picture one below the other, each as a grey PNG (filtered by row, deflated): a
//! picture of 320 x 240 takes some 45 kB of 77, patches 0.4 kB of 0.6. Coarser levels follow from the finest one and are not kept.
//! Cost: 2 ms to write, 1 ms to read. A condensed picture is another kind of record: 4 kB for its coarse level, half a kilobyte a view.

use ::png::{BitDepth, ColorType, Compression, Decoder, Encoder, Limits};
use serde::{Deserialize, Serialize};

use crate::features::descriptor::Descriptor;
use crate::image::GreyImage;
use crate::map::away::MOST_NUMBERED;
use crate::map::picture::{CONDENSED_LEVEL, KeyframePicture, PATCH_PX, Patch};
use crate::map::view::{CoarseDescriptor, SmallPatch, View};

/// Larger pictures are no camera's, px a side.
const MOST_SIDE: u32 = 16_384;
/// Memory that the decoder may take, bytes.
const LIMIT_BYTES: usize = 8 << 20;

#[derive(Serialize, Deserialize)]
struct PictureRecord {
    is_whole: bool,
    levels: u8,
    finest: Vec<u8>,
    /// Landmark, left, top.
    places: Vec<(u32, u16, u16)>,
    patches: Vec<u8>,
}

/// The record of a picture; `None` where there is none.
pub fn encode(picture: &KeyframePicture) -> Option<Vec<u8>> {
    let kept = picture.kept()?;
    let mut places = Vec::new();
    let mut pixels = Vec::new();
    for (landmark, [left, top], patch) in picture.patches() {
        places.push((landmark, left, top));
        pixels.extend(patch);
    }
    let patches = GreyImage { width: PATCH_PX, height: PATCH_PX * places.len(), data: pixels };
    let record = PictureRecord {
        is_whole: kept.level == 0,
        levels: u8::try_from(kept.levels).ok()?,
        finest: png(kept.finest)?,
        patches: if places.is_empty() { Vec::new() } else { png(&patches)? },
        places,
    };
    postcard::to_stdvec(&record).ok()
}

/// The picture of a record; `None` if it is not one.
pub fn decode(record: &[u8]) -> Option<KeyframePicture> {
    let record: PictureRecord = postcard::from_bytes(record).ok()?;
    let finest = grey(&record.finest)?;
    let mut patches = Vec::with_capacity(record.places.len());
    if !record.places.is_empty() {
        let all = grey(&record.patches)?;
        if (all.width, all.height) != (PATCH_PX, PATCH_PX * record.places.len()) {
            return None;
        }
        for (&(landmark, left, top), pixels) in record.places.iter().zip(all.data.chunks_exact(PATCH_PX * PATCH_PX)) {
            let pixels = Box::new(pixels.try_into().ok()?);
            patches.push(Patch { landmark, left, top, pixels });
        }
    }
    Some(KeyframePicture::restored(finest, record.is_whole, usize::from(record.levels), patches))
}

#[derive(Serialize, Deserialize)]
struct CondensedRecord {
    levels: u8,
    finest: Vec<u8>,
    views: Vec<ViewRecord>,
    place: Vec<[[u8; 8]; 4]>,
}

#[derive(Serialize, Deserialize)]
struct PatchRecord {
    left: u16,
    top: u16,
    darkest: u8,
    brightest: u8,
    packed: Vec<u8>,
}

#[derive(Serialize, Deserialize)]
struct ViewRecord {
    landmark: u32,
    /// By level.
    patches: [Option<PatchRecord>; 2],
    /// By level.
    described: [Option<Vec<u8>>; 3],
}

/// The record of a condensed picture; `None` where it is another.
pub fn encode_condensed(picture: &KeyframePicture) -> Option<Vec<u8>> {
    let kept = picture.kept().filter(|kept| picture.is_condensed() && kept.level == CONDENSED_LEVEL)?;
    let patch = |p: &SmallPatch| {
        let SmallPatch { left, top, darkest, brightest, packed } = p;
        let (left, top, darkest, brightest) = (*left, *top, *darkest, *brightest);
        PatchRecord { left, top, darkest, brightest, packed: packed.to_vec() }
    };
    let view = |view: &View| ViewRecord {
        landmark: view.landmark,
        patches: view.patches.each_ref().map(|p| p.as_ref().map(patch)),
        described: view.described.each_ref().map(|d| d.as_ref().map(|d| d.0.to_vec())),
    };
    let record = CondensedRecord {
        levels: u8::try_from(kept.levels).ok()?,
        finest: png(kept.finest)?,
        views: picture.views().iter().map(view).collect(),
        place: picture.place_descriptors().iter().map(|d| d.0.map(u64::to_le_bytes)).collect(),
    };
    postcard::to_stdvec(&record).ok()
}

/// `None` if it makes no sense.
fn patch(record: Option<PatchRecord>) -> Option<Option<SmallPatch>> {
    let Some(PatchRecord { left, top, darkest, brightest, packed }) = record else { return Some(None) };
    let packed = packed.try_into().ok()?;
    (darkest <= brightest).then_some(Some(SmallPatch { left, top, darkest, brightest, packed }))
}

/// `None` if it makes no sense.
fn descriptor(record: Option<Vec<u8>>) -> Option<Option<CoarseDescriptor>> {
    let Some(packed) = record else { return Some(None) };
    Some(Some(CoarseDescriptor(packed.try_into().ok()?)))
}

/// The condensed picture of a record; `None` if it is not one.
pub fn decode_condensed(record: &[u8]) -> Option<KeyframePicture> {
    let record: CondensedRecord = postcard::from_bytes(record).ok()?;
    let finest = grey(&record.finest)?;
    let mut views = Vec::with_capacity(record.views.len());
    for v in record.views {
        let [fine, half] = v.patches;
        let patches = [patch(fine)?, patch(half)?];
        let [fine, half, quarter] = v.described;
        let described = [descriptor(fine)?, descriptor(half)?, descriptor(quarter)?];
        views.push(View { landmark: v.landmark, patches, described });
    }
    let is_small = views.len() <= MOST_NUMBERED;
    let is_one = is_small && usize::from(record.levels) > CONDENSED_LEVEL && !finest.data.is_empty();
    let place = record.place.into_iter().map(|d| Descriptor(d.map(u64::from_le_bytes))).collect();
    is_one.then(|| KeyframePicture::restored_condensed(finest, usize::from(record.levels), views, place))
}

fn png(image: &GreyImage) -> Option<Vec<u8>> {
    let mut out = Vec::new();
    let (width, height) = (u32::try_from(image.width).ok()?, u32::try_from(image.height).ok()?);
    let mut encoder = Encoder::new(&mut out, width, height);
    encoder.set_color(ColorType::Grayscale);
    encoder.set_depth(BitDepth::Eight);
    encoder.set_compression(Compression::Fast);
    let mut writer = encoder.write_header().ok()?;
    writer.write_image_data(&image.data).ok()?;
    writer.finish().ok()?;
    Some(out)
}

fn grey(png: &[u8]) -> Option<GreyImage> {
    let decoder = Decoder::new_with_limits(std::io::Cursor::new(png), Limits { bytes: LIMIT_BYTES });
    let mut reader = decoder.read_info().ok()?;
    let (width, height) = (reader.info().width, reader.info().height);
    if reader.output_color_type() != (ColorType::Grayscale, BitDepth::Eight) || width.max(height) > MOST_SIDE {
        return None;
    }
    let mut image = GreyImage::new(width as usize, height as usize);
    reader.next_frame(&mut image.data).ok()?;
    Some(image)
}
