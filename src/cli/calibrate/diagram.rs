//! The reliability diagram as a picture: predicted probability against observed share, and how many predictions there are.

use std::fmt::Write as _;

use crate::calibrate::{Bin, Reliability};

/// The square of the diagram, pixels, and where its lower left corner lies.
const SIDE: f64 = 360.0;
const LEFT: f64 = 64.0;
const BOTTOM: f64 = 400.0;
/// Height of the bars that count predictions, and where they stand.
const BARS: f64 = 70.0;
const BARS_BOTTOM: f64 = 520.0;
const STEPS: [f64; 6] = [0.0, 0.2, 0.4, 0.6, 0.8, 1.0];

/// Draws the diagram; empty axes without predictions.
pub(super) fn svg(reliability: Option<&Reliability>) -> String {
    let none = Reliability { bins: Vec::new(), error: 0.0 };
    let Reliability { bins, error } = reliability.unwrap_or(&none);
    let mut svg = String::from(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 460 570\" width=\"460\" height=\"570\" \
         font-family=\"sans-serif\" font-size=\"13\" fill=\"#222\">\n<rect width=\"460\" height=\"570\" fill=\"#fff\"/>\n",
    );
    let (x, y) = (|p: f64| LEFT + SIDE * p, |p: f64| BOTTOM - SIDE * p);
    for step in STEPS {
        let (at_x, at_y) = (x(step), y(step));
        let _ = writeln!(
            svg,
            "<path d=\"M{at_x:.1} {BOTTOM} V{:.1} M{LEFT} {at_y:.1} H{:.1}\" stroke=\"#ddd\" fill=\"none\"/>\n\
             <text x=\"{at_x:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{step}</text>\n\
             <text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">{step}</text>",
            y(1.0),
            x(1.0),
            BOTTOM + 18.0,
            LEFT - 8.0,
            at_y + 4.5
        );
    }
    let _ = writeln!(
        svg,
        "<path d=\"M{LEFT} {BOTTOM} L{:.1} {:.1}\" stroke=\"#888\" stroke-dasharray=\"5 4\" fill=\"none\"/>",
        x(1.0),
        y(1.0)
    );
    let line: Vec<String> =
        bins.iter().map(|bin| format!("{:.1},{:.1}", x(bin.predicted), y(bin.observed))).collect();
    let _ = writeln!(
        svg,
        "<polyline points=\"{}\" stroke=\"#1a6fb5\" stroke-width=\"2\" fill=\"none\"/>",
        line.join(" ")
    );
    let most = bins.iter().map(log_count).fold(1.0, f64::max);
    for bin in bins {
        let (low, high) = interval(bin);
        let (left, right, height) = (x(bin.low), x(bin.high), BARS * log_count(bin) / most);
        let _ = writeln!(
            svg,
            "<path d=\"M{0:.1} {1:.1} V{2:.1}\" stroke=\"#1a6fb5\" stroke-width=\"1.5\"/>\n\
             <circle cx=\"{0:.1}\" cy=\"{3:.1}\" r=\"4\" fill=\"#1a6fb5\"/>\n\
             <rect x=\"{left:.1}\" y=\"{4:.1}\" width=\"{5:.1}\" height=\"{height:.1}\" fill=\"#9cc3e2\" stroke=\"#fff\"/>",
            x(bin.predicted),
            y(low),
            y(high),
            y(bin.observed),
            BARS_BOTTOM - height,
            right - left
        );
    }
    let middle = x(0.5);
    let _ = writeln!(
        svg,
        "<text x=\"{middle}\" y=\"24\" font-size=\"15\" text-anchor=\"middle\">Held-out predictions: expected error {:.1} %</text>\n\
         <text x=\"{middle}\" y=\"{:.1}\" text-anchor=\"middle\">predicted probability that a pose is right</text>\n\
         <text transform=\"translate(22 {:.1}) rotate(-90)\" text-anchor=\"middle\">share that is right</text>\n\
         <text x=\"{middle}\" y=\"{:.1}\" text-anchor=\"middle\">number of predictions, up to {}, on a logarithmic scale</text>\n</svg>",
        100.0 * error,
        BOTTOM + 38.0,
        y(0.5),
        BARS_BOTTOM + 22.0,
        bins.iter().map(|bin| bin.count).max().unwrap_or(0)
    );
    svg
}

fn log_count(bin: &Bin) -> f64 {
    (1.0 + bin.count as f64).ln()
}

/// Where the share truly lies with 95 % if the predictions of the bin are independent (Wilson).
fn interval(bin: &Bin) -> (f64, f64) {
    const Z: f64 = 1.96;
    let (n, p) = (bin.count.max(1) as f64, bin.observed);
    let centre = (p + Z * Z / (2.0 * n)) / (1.0 + Z * Z / n);
    let half = Z / (1.0 + Z * Z / n) * (p * (1.0 - p) / n + Z * Z / (4.0 * n * n)).sqrt();
    ((centre - half).max(0.0), (centre + half).min(1.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_bin_is_drawn_within_the_picture() {
        let predictions: Vec<(f64, bool, f64)> =
            (0..400).map(|i| (f64::from(i) * 0.04 - 8.0, i % 400 > (i * 7) % 400, 1.0)).collect();
        let reliability = Reliability::of(&predictions);
        let svg = svg(Some(&reliability));
        assert_eq!(svg.matches("<circle").count(), reliability.bins.len());
        assert!(svg.starts_with("<svg") && svg.ends_with("</svg>\n") && !svg.contains("NaN"));
    }

    #[test]
    fn few_predictions_say_little() {
        let bin = |count, observed| Bin { count, observed, ..Bin::default() };
        let (low, high) = interval(&bin(4, 1.0));
        assert!(low < 0.6 && high == 1.0);
        let (low, high) = interval(&bin(4000, 0.5));
        assert!(high - low < 0.04);
    }
}
