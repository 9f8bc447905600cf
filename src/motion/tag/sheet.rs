//! A tag to print, with its measures on it.
//!
//! Number and size -> an SVG in millimetres: the tag with its white rim of a cell, which side is up, a ruler to check the printer with, and in
//! words which tag it is, how large, and what stands in the configuration for it.

use super::{LEAST_SIZE_M, MOST_SIZE_M};
use crate::features::tags::{CELLS, FAMILY_SIZE, is_white};

/// Cells along a tag's black square, its border included; of what [`is_white_cell`] tells.
pub const SIDE_CELLS: usize = CELLS;

/// Whether a cell of a tag is white, as one looks at it: column and row from the top left.
pub fn is_white_cell(id: u16, column: usize, row: usize) -> bool {
    is_white(id, column, row)
}

/// The paper that most printers have, shorter and longer side, and what a printer leaves free on each side, mm.
const A4_MM: [f64; 2] = [210.0, 297.0];
const PRINTERS_MARGIN_MM: f64 = 5.0;

/// What cannot be printed.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum SheetError {
    #[error("tag {0}: the family 36h11 has the tags 0 to {last}", last = FAMILY_SIZE - 1)]
    NoSuchTag(u32),
    #[error("size {0} m: must lie in {LEAST_SIZE_M}..={MOST_SIZE_M} m (the black square's side; 150 mm is 0.15)")]
    Size(f64),
}

/// A tag of a size.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sheet {
    id: u16,
    size_m: f64,
}

/// Measures of a sheet, mm.
struct Measures {
    side: f64,
    margin: f64,
    /// Height of the letters.
    text: f64,
    sheet: [f64; 2],
}

impl Sheet {
    /// Tag `id`, whose black square has sides of `size_m` metres.
    pub fn new(id: u32, size_m: f64) -> Result<Self, SheetError> {
        // Written so that NaN fails.
        if !(LEAST_SIZE_M..=MOST_SIZE_M).contains(&size_m) {
            return Err(SheetError::Size(size_m));
        }
        match u16::try_from(id) {
            Ok(id) if id < FAMILY_SIZE => Ok(Self { id, size_m }),
            _ => Err(SheetError::NoSuchTag(id)),
        }
    }

    fn measures(&self) -> Measures {
        // A thousandth of a millimetre is what the sheet says.
        let side = (self.size_m * 1e6).round() / 1e3;
        // The rim of a cell that the detector needs, and room to cut.
        let margin = (side / CELLS as f64).max(5.0);
        let text = (0.03 * side).clamp(1.5, 6.0);
        // The longest line is some 36 letters' heights long, and begins at the left margin.
        let width = (side + 2.0 * margin).max(38.0 * text + margin);
        Measures { side, margin, text, sheet: [width, side + 2.0 * margin + 9.0 * text] }
    }

    /// The sheet's size and whether it fits on A4, in words.
    pub fn paper(&self) -> String {
        let [w, h] = self.measures().sheet;
        let size = format!("{w:.0} x {h:.0} mm");
        let room = A4_MM.map(|side| side - 2.0 * PRINTERS_MARGIN_MM);
        if w <= room[0] && h <= room[1] { format!("{size}, fits on A4") } else { format!("{size}, larger than A4") }
    }

    /// The sheet as SVG.
    pub fn svg(&self) -> String {
        let Measures { side, margin, text, sheet: [w, h] } = self.measures();
        let left = 0.5 * (w - side);
        let cell = side / CELLS as f64;
        // One path: side by side, cells of their own would show seams.
        let mut white = String::new();
        for row in 0..CELLS {
            for column in (0..CELLS).filter(|&c| is_white(self.id, c, row)) {
                white += &format!(
                    "M{:.4} {:.4}h{cell:.4}v{cell:.4}h-{cell:.4}z",
                    left + column as f64 * cell,
                    margin + row as f64 * cell
                );
            }
        }
        let mut out = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{w:.3}mm\" height=\"{h:.3}mm\" viewBox=\"0 0 {w:.3} {h:.3}\">\n\
             <rect width=\"{w:.3}\" height=\"{h:.3}\" fill=\"white\"/>\n\
             <rect x=\"{left:.4}\" y=\"{margin:.4}\" width=\"{side:.4}\" height=\"{side:.4}\" fill=\"black\"/>\n\
             <path d=\"{white}\" fill=\"white\"/>\n"
        );
        // A ruler of whole centimetres, at most 100 mm.
        let ruler = (side / 10.0).floor().clamp(1.0, 10.0) * 10.0;
        let y = side + 2.0 * margin + text;
        out += &format!(
            "<path d=\"M{margin:.3} {y:.3}v{text:.3}m0 -{half:.3}h{ruler:.3}m0 {half:.3}v-{text:.3}\" stroke=\"black\" stroke-width=\"0.25\" \
             fill=\"none\"/>\n",
            half = 0.5 * text,
        );
        let mm = |value: f64| format!("{value:.3}").trim_end_matches('0').trim_end_matches('.').to_owned();
        let lines = [
            format!("The line above: {ruler:.0} mm. The black square: {} mm.", mm(side)),
            format!("AprilTag 36h11, ID {}. This side down.", self.id),
            format!("[tag] size_m = {}", self.size_m),
            "Print at 100 %, measure, glue onto something flat; keep the white rim.".into(),
        ];
        for (n, line) in lines.iter().enumerate() {
            let y = y + (2.4 + 1.5 * n as f64) * text;
            out += &format!(
                "<text x=\"{margin:.3}\" y=\"{y:.3}\" font-family=\"sans-serif\" font-size=\"{text:.3}\">{line}</text>\n"
            );
        }
        out + "</svg>\n"
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::features::tags::TagDetector;
    use crate::image::GreyImage;

    /// The sheet as a printer of 4 pixels a millimetre would have it: its rectangles and its path of squares.
    fn printed(svg: &str) -> (GreyImage, f64) {
        let document = roxmltree::Document::parse(svg).expect("well-formed");
        let root = document.root_element();
        let mm = |text: &str| text.trim_end_matches("mm").parse::<f64>().expect("mm");
        let (width, height) =
            (mm(root.attribute("width").expect("width")), mm(root.attribute("height").expect("height")));
        let scale = 4.0;
        let mut image = GreyImage::new((width * scale) as usize, (height * scale) as usize);
        let mut fill = |x: f64, y: f64, w: f64, h: f64, value: u8| {
            for row in 0..image.height {
                for column in 0..image.width {
                    let (u, v) = ((column as f64 + 0.5) / scale, (row as f64 + 0.5) / scale);
                    if (x..x + w).contains(&u) && (y..y + h).contains(&v) {
                        image.data[row * image.width + column] = value;
                    }
                }
            }
        };
        for rect in document.descendants().filter(|n| n.has_tag_name("rect")) {
            let number = |key: &str| rect.attribute(key).map_or(0.0, mm);
            let value = if rect.attribute("fill") == Some("white") { 235 } else { 15 };
            fill(number("x"), number("y"), number("width"), number("height"), value);
        }
        let path = document.descendants().find(|n| n.attribute("fill") == Some("white") && n.has_tag_name("path"));
        for square in path.and_then(|n| n.attribute("d")).expect("cells").split('M').skip(1) {
            let numbers: Vec<f64> =
                square.split(|c: char| c.is_alphabetic() || c == ' ').filter_map(|n| n.parse().ok()).collect();
            fill(numbers[0], numbers[1], numbers[2], numbers[3], 235);
        }
        (image, scale)
    }

    #[test]
    fn the_sheet_is_read_back_with_its_number_upright_and_in_true_size() {
        for (id, size_m) in [(0, 0.15), (7, 0.05), (586, 0.0945)] {
            let (image, pixels_a_mm) = printed(&Sheet::new(id, size_m).expect("valid").svg());
            let mut tags = Vec::new();
            TagDetector::default().detect(&image, &mut tags);
            let [tag] = tags[..] else { panic!("{} tags", tags.len()) };
            assert_eq!((u32::from(tag.id), tag.wrong), (id, 0));
            let across = tag.corners[1] - tag.corners[0];
            assert!(across.x > 0.0 && across.y.abs() < 0.1, "upright: {across}");
            let found_m = across.norm() / pixels_a_mm / 1000.0;
            assert!((found_m / size_m - 1.0).abs() < 0.004, "{size_m} m is {found_m} m");
        }
    }

    #[test]
    fn the_words_name_number_size_key_and_ruler() {
        let sheet = Sheet::new(12, 0.0945).expect("valid");
        let svg = sheet.svg();
        for words in ["ID 12.", "black square: 94.5 mm", "[tag] size_m = 0.0945", "line above: 90 mm"] {
            assert!(svg.contains(words), "{words}");
        }
        assert!(sheet.paper().contains("fits on A4"));
        assert!(Sheet::new(0, 0.3).expect("valid").paper().contains("larger than A4"));
    }

    #[test]
    fn the_words_of_the_smallest_sheets_stay_on_them() {
        for size_m in [0.01, 0.02, 0.035, 0.05, 0.15, 0.5] {
            let svg = Sheet::new(0, size_m).expect("valid").svg();
            let document = roxmltree::Document::parse(&svg).expect("well-formed");
            let number = |node: roxmltree::Node<'_, '_>, key: &str| {
                node.attribute(key).expect(key).trim_end_matches("mm").parse::<f64>().expect("number")
            };
            let width = number(document.root_element(), "width");
            for text in document.descendants().filter(|n| n.has_tag_name("text")) {
                // Letters of a sans-serif are about half as wide as high.
                let letters = text.text().expect("words").chars().count() as f64;
                let end = number(text, "x") + 0.52 * letters * number(text, "font-size");
                assert!(end <= width, "{size_m} m: ends at {end} of {width} mm");
            }
        }
    }

    #[test]
    fn what_cannot_be_printed_is_named_with_its_range_and_unit() {
        assert_eq!(
            Sheet::new(587, 0.15).map_err(|e| e.to_string()),
            Err("tag 587: the family 36h11 has the tags 0 to 586".into())
        );
        for size in [15.0, 0.0, -1.0, f64::NAN, f64::INFINITY] {
            let said = Sheet::new(0, size).expect_err("refused").to_string();
            assert!(said.contains(" m: must lie in 0.01..=2 m"), "{said}");
        }
    }
}
