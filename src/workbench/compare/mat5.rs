//! Annotated points out of a MATLAB 5 file.
//!
//! Input: the bytes of a `.mat` file (level 5, little-endian, elements compressed or not) that holds, anywhere in its
//! structures, a 6 x N matrix: homogeneous points of the first picture above those of the second. Output: N pairs.
//! Reference: MathWorks, "MAT-File Format" (level 5). Cost: linear.
//!
//! Deliberately not here: writing, cells, sparse and complex matrices, level 7.3 (which is HDF5).

use std::io::Read;

use nalgebra::Vector2;

/// No annotation is longer once inflated, bytes.
const MAX_INFLATED: u64 = 16 << 20;
/// Structures within structures.
const MAX_DEPTH: usize = 8;

const COMPRESSED: u32 = 15;
const MATRIX: u32 = 14;
const CLASS_STRUCT: u8 = 2;

/// The first 6 x N matrix of a file, as pairs of points.
pub fn read_pairs(data: &[u8]) -> Result<Vec<[Vector2<f64>; 2]>, String> {
    if data.get(126..128) != Some(b"IM") {
        return Err("is no little-endian MATLAB 5 file".into());
    }
    let mut rest = data.get(128..).unwrap_or_default();
    while let Some((kind, content, after)) = element(rest) {
        let mut inflated = Vec::new();
        let matrix = if kind == COMPRESSED {
            flate2::read::ZlibDecoder::new(content)
                .take(MAX_INFLATED)
                .read_to_end(&mut inflated)
                .map_err(|e| format!("cannot be inflated: {e}"))?;
            element(&inflated).filter(|(kind, ..)| *kind == MATRIX).map(|(_, content, _)| content)
        } else {
            (kind == MATRIX).then_some(content)
        };
        if let Some(numbers) = matrix.and_then(|m| six_rows(m, 0)) {
            return numbers.chunks_exact(6).map(pair).collect();
        }
        rest = after;
    }
    Err("holds no 6 x N matrix of points".into())
}

fn pair(v: &[f64]) -> Result<[Vector2<f64>; 2], String> {
    let points = [Vector2::new(v[0] / v[2], v[1] / v[2]), Vector2::new(v[3] / v[5], v[4] / v[5])];
    let finite = points.iter().all(|p| p.iter().all(|v| v.is_finite()));
    finite.then_some(points).ok_or_else(|| "holds a point that is not finite".into())
}

/// Type, content and what follows of the next element.
fn element(data: &[u8]) -> Option<(u32, &[u8], &[u8])> {
    let word = |at: usize| Some(u32::from_le_bytes(data.get(at..at + 4)?.try_into().ok()?));
    let (tag, length) = (word(0)?, word(4)?);
    // A small element has its length in the upper half of the tag, and its content in the next four bytes.
    if tag >> 16 != 0 {
        let length = (tag >> 16) as usize;
        return Some((tag & 0xffff, data.get(4..4 + length.min(4))?, data.get(8..)?));
    }
    let end = 8usize.checked_add(length as usize)?;
    let content = data.get(8..end)?;
    // Padded to eight bytes, but for compressed ones.
    let padded = if tag == COMPRESSED { end } else { end.div_ceil(8) * 8 };
    Some((tag, content, data.get(padded..).unwrap_or_default()))
}

/// The numbers (column by column) of the first 6 x N matrix in a matrix element.
fn six_rows(matrix: &[u8], depth: usize) -> Option<Vec<f64>> {
    if depth > MAX_DEPTH {
        return None;
    }
    let (_, flags, rest) = element(matrix)?;
    let (_, dimensions, rest) = element(rest)?;
    let (_, _name, rest) = element(rest)?;
    let class = *flags.first()?;
    if class == CLASS_STRUCT {
        let (_, _name_length, rest) = element(rest)?;
        let (_, _names, mut rest) = element(rest)?;
        while let Some((kind, content, after)) = element(rest) {
            if let Some(found) = (kind == MATRIX).then(|| six_rows(content, depth + 1)).flatten() {
                return Some(found);
            }
            rest = after;
        }
        return None;
    }
    let size = |at: usize| Some(i32::from_le_bytes(dimensions.get(at..at + 4)?.try_into().ok()?));
    // Numeric classes are 6 (double) to 13.
    if !(6..=13).contains(&class) || dimensions.len() != 8 || size(0)? != 6 || size(4)? < 1 {
        return None;
    }
    let (kind, content, _) = element(rest)?;
    let numbers = numbers(kind, content)?;
    (numbers.len() == 6 * size(4)? as usize).then_some(numbers)
}

/// Numbers of an element, whichever type they are stored as.
fn numbers(kind: u32, content: &[u8]) -> Option<Vec<f64>> {
    fn each<const N: usize>(content: &[u8], read: impl Fn([u8; N]) -> f64) -> Vec<f64> {
        content.as_chunks::<N>().0.iter().map(|chunk| read(*chunk)).collect()
    }
    Some(match kind {
        1 => each(content, |b: [u8; 1]| f64::from(b[0] as i8)),
        2 => each(content, |b: [u8; 1]| f64::from(b[0])),
        3 => each(content, |b| f64::from(i16::from_le_bytes(b))),
        4 => each(content, |b| f64::from(u16::from_le_bytes(b))),
        5 => each(content, |b| f64::from(i32::from_le_bytes(b))),
        6 => each(content, |b| f64::from(u32::from_le_bytes(b))),
        7 => each(content, |b| f64::from(f32::from_le_bytes(b))),
        9 => each(content, f64::from_le_bytes),
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use super::*;

    fn tagged(kind: u32, content: &[u8]) -> Vec<u8> {
        let mut out = kind.to_le_bytes().to_vec();
        out.extend((content.len() as u32).to_le_bytes());
        out.extend(content);
        out.resize(out.len().div_ceil(8) * 8, 0);
        out
    }

    fn matrix(class: u8, dimensions: [i32; 2], content: &[u8]) -> Vec<u8> {
        let mut inside = tagged(6, &[class, 0, 0, 0, 0, 0, 0, 0]);
        inside.extend(tagged(5, &dimensions.map(i32::to_le_bytes).concat()));
        // A name of two letters, as a small element.
        inside.extend([1, 0, 2, 0, b'a', b'b', 0, 0]);
        inside.extend(content);
        tagged(MATRIX, &inside)
    }

    fn file(elements: &[u8]) -> Vec<u8> {
        let mut out = vec![b' '; 124];
        out.extend([0, 1]);
        out.extend(b"IM");
        out.extend(elements);
        out
    }

    #[test]
    fn points_are_found_inside_a_compressed_structure() {
        let values: Vec<u8> = [10.0, 20.0, 1.0, 60.0, 80.0, 2.0f64].iter().flat_map(|v| v.to_le_bytes()).collect();
        let points = matrix(6, [6, 1], &tagged(9, &values));
        let mut fields = tagged(5, &[8, 0, 0, 0]);
        fields.extend(tagged(1, b"fname\0\0\0pts\0\0\0\0\0"));
        fields.extend(matrix(6, [2, 1], &tagged(2, &[1, 2])));
        fields.extend(points);
        let structure = matrix(CLASS_STRUCT, [1, 1], &fields);
        let mut encoder = flate2::write::ZlibEncoder::new(Vec::new(), flate2::Compression::default());
        encoder.write_all(&structure).unwrap();
        let squeezed = encoder.finish().unwrap();
        let mut element = COMPRESSED.to_le_bytes().to_vec();
        element.extend((squeezed.len() as u32).to_le_bytes());
        element.extend(&squeezed);
        for elements in [&element, &structure] {
            let pairs = read_pairs(&file(elements)).expect("points");
            assert_eq!(pairs, [[Vector2::new(10.0, 20.0), Vector2::new(30.0, 40.0)]]);
        }
    }

    #[test]
    fn broken_files_are_refused_and_never_panic() {
        let values = [1u8; 48];
        let whole = file(&matrix(6, [6, 8], &tagged(2, &values)));
        assert_eq!(read_pairs(&whole).expect("points").len(), 8);
        for length in 0..whole.len() {
            let _ = read_pairs(&whole[..length]);
        }
        for at in 128..whole.len() {
            let mut broken = whole.clone();
            broken[at] ^= 0xff;
            let _ = read_pairs(&broken);
        }
        assert!(read_pairs(b"").is_err() && read_pairs(&file(&[])).is_err());
    }
}
