//! A chessboard to print, with its measures on it.
//!
//! Input: a [`Pattern`]. Output: an SVG in millimetres whose squares have the stated side when it is printed at 100 %, with a margin of a
//! square (the detector wants light around the board) and a ruler to check the printer with.

use super::chessboard::Pattern;

/// The sheet as SVG.
pub fn svg(pattern: &Pattern) -> String {
    let side = pattern.square_m * 1000.0;
    let (columns, rows) = (pattern.columns + 1, pattern.rows + 1);
    let margin = side.max(10.0);
    let (board_w, board_h) = (f64::from(columns) * side, f64::from(rows) * side);
    let text = (0.02 * board_w).clamp(2.5, 6.0);
    let (w, h) = (board_w + 2.0 * margin, board_h + 2.0 * margin + 4.0 * text);
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
    out += &format!(
        "<text x=\"{margin:.3}\" y=\"{:.3}\" font-family=\"sans-serif\" font-size=\"{text:.3}\">\
         cairn calibrate --pattern {}x{} --square {} ({} x {} squares of {side} mm). Print at 100 %, measure, glue onto something flat.\
         </text>\n</svg>\n",
        y + 2.6 * text,
        pattern.columns,
        pattern.rows,
        pattern.square_m,
        columns,
        rows,
    );
    out
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
}
