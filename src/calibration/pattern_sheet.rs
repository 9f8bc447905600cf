//! A chessboard to print, with its measures on it.
//!
//! Input: a [`Pattern`]. Output: an SVG in millimetres whose squares have the stated side when it is printed at 100 %, with a margin of a
//! square (the detector wants light around the board) and a ruler to check the printer with; and whether it fits on paper.

use super::chessboard::Pattern;

/// The paper that most printers have, and the next larger one: longer and shorter side, mm.
const A4_MM: [f64; 2] = [297.0, 210.0];
const A3_MM: [f64; 2] = [420.0, 297.0];

/// Measures of a sheet, mm.
struct Measures {
    side: f64,
    margin: f64,
    board: [f64; 2],
    /// Height of the letters.
    text: f64,
    sheet: [f64; 2],
}

fn measures(pattern: &Pattern) -> Measures {
    let side = pattern.square_m * 1000.0;
    let margin = side.max(10.0);
    let board = [pattern.columns, pattern.rows].map(|n| f64::from(n + 1) * side);
    let text = (0.02 * board[0]).clamp(2.5, 6.0);
    let sheet = [board[0] + 2.0 * margin, board[1] + 2.0 * margin + 6.0 * text];
    Measures { side, margin, board, text, sheet }
}

/// Does the sheet fit, lying or standing?
fn fits(pattern: &Pattern, paper_mm: [f64; 2]) -> bool {
    let [w, h] = measures(pattern).sheet;
    w.max(h) <= paper_mm[0] && w.min(h) <= paper_mm[1]
}

/// The sheet's size and which paper it needs, in words.
pub fn paper(pattern: &Pattern) -> String {
    let [w, h] = measures(pattern).sheet;
    let size = format!("{w:.0} x {h:.0} mm");
    if fits(pattern, A4_MM) {
        return format!("{size}, fits on A4");
    }
    let needs = if fits(pattern, A3_MM) { "needs A3" } else { "is larger than A3" };
    let smaller = (5..100u32).rev().map(|mm| f64::from(mm) / 1000.0);
    let smaller =
        smaller.filter(|s| *s < pattern.square_m).find(|s| fits(&Pattern { square_m: *s, ..*pattern }, A4_MM));
    match smaller {
        Some(square_m) => format!("{size}, {needs}; on A4 it fits with --square {square_m}"),
        None => format!("{size}, {needs}"),
    }
}

/// The sheet as SVG.
pub fn svg(pattern: &Pattern) -> String {
    let Measures { side, margin, board: [board_w, board_h], text, sheet: [w, h] } = measures(pattern);
    let (columns, rows) = (pattern.columns + 1, pattern.rows + 1);
    let mut out = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{w:.3}mm\" height=\"{h:.3}mm\" viewBox=\"0 0 {w:.3} {h:.3}\">\n\
         <rect width=\"{w:.3}\" height=\"{h:.3}\" fill=\"white\"/>\n<g fill=\"black\" shape-rendering=\"crispEdges\">\n"
    );
    for row in 0..rows {
        for column in (row % 2..columns).step_by(2) {
            out += &format!(
                "<rect x=\"{:.3}\" y=\"{:.3}\" width=\"{side:.3}\" height=\"{side:.3}\"/>\n",
                margin + f64::from(column) * side,
                margin + f64::from(row) * side
            );
        }
    }
    // A ruler of whole centimetres, at most 100 mm.
    let ruler = (board_w / 10.0).floor().clamp(1.0, 10.0) * 10.0;
    let y = board_h + 2.0 * margin;
    out += &format!(
        "</g>\n<path d=\"M {margin:.3} {y:.3} v {tick:.3} m 0 {half:.3} h {ruler:.3} m 0 {half:.3} v -{tick:.3}\" \
         stroke=\"black\" stroke-width=\"0.25\" fill=\"none\"/>\n",
        tick = text,
        half = -0.5 * text,
    );
    out += &format!(
        "<text x=\"{:.3}\" y=\"{:.3}\" font-family=\"sans-serif\" font-size=\"{text:.3}\">this line: {ruler:.0} mm</text>\n",
        margin + ruler + text,
        y + 0.8 * text
    );
    let lines = [
        format!("cairn calibrate --pattern {}x{} --square {}", pattern.columns, pattern.rows, pattern.square_m),
        format!("{columns} x {rows} squares of {side} mm. Print at 100 %, measure, glue onto something flat."),
    ];
    for (n, line) in lines.iter().enumerate() {
        let y = y + (2.6 + 1.5 * n as f64) * text;
        out += &format!(
            "<text x=\"{margin:.3}\" y=\"{y:.3}\" font-family=\"sans-serif\" font-size=\"{text:.3}\">{line}</text>\n"
        );
    }
    out + "</svg>\n"
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_sheet_has_the_squares_in_millimetres() {
        let text = svg(&Pattern::new(9, 6, 0.025).expect("valid"));
        let document = roxmltree::Document::parse(&text).expect("well-formed");
        let squares: Vec<_> = document.descendants().filter(|n| n.attribute("width") == Some("25.000")).collect();
        assert_eq!(squares.len(), 35, "half of 10 x 7 squares");
        assert_eq!(document.root_element().attribute("width"), Some("300.000mm"));
        assert!(text.contains("--pattern 9x6 --square 0.025") && text.contains("100 mm"));
    }

    #[test]
    fn the_words_name_the_paper_and_a_square_that_fits_on_a4() {
        let words = |square_m: f64| paper(&Pattern::new(9, 6, square_m).expect("valid"));
        assert!(words(0.025).contains("needs A3; on A4 it fits with --square 0.02"), "{}", words(0.025));
        assert!(words(0.02).contains("fits on A4"), "{}", words(0.02));
        assert!(words(0.05).contains("larger than A3; on A4 it fits with --square 0.02"), "{}", words(0.05));
    }
}
