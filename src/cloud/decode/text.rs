//! XYZ and PTS: a point a line, in the spellings that programs and locales have.
//!
//! Values are separated by whitespace, commas or semicolons, as the first row shows. Where commas do not separate, they are
//! decimal marks. A first line (or a comment right before the rows, as `CloudCompare` writes) may name the columns;
//! otherwise they are `x y z`, then `r g b` (6 columns) or `intensity r g b` (7 columns) where those are whole numbers up to
//! 255. PTS begins with the number of its points, and may hold several such blocks.

use super::collector::Collector;
use super::source::{Source, number};
use super::{DecodeError, Format};

/// How many rows decide whether unnamed columns are colours.
const PROBE_ROWS: usize = 64;

/// What the first line with content is.
pub(super) enum FirstLine {
    /// One whole number, and rows (or nothing) after it.
    Count,
    /// Names of columns, x, y and z among them.
    Columns,
    /// At least three numbers.
    Row,
}

/// Looks for text of numbers at the head of a file. `None` when it is something else.
pub(super) fn first_line(head: &[u8]) -> Option<FirstLine> {
    let head = head.strip_prefix(b"\xef\xbb\xbf").unwrap_or(head);
    let mut counted = false;
    for line in head.split(|&byte| byte == b'\n') {
        let line = line.trim_ascii();
        if line.is_empty() || is_comment(line) {
            continue;
        }
        let line = std::str::from_utf8(line).ok()?;
        if counted {
            return is_row(line).then_some(FirstLine::Count);
        }
        if is_row(line) {
            return Some(FirstLine::Row);
        }
        if Columns::named(line).is_some() {
            return Some(FirstLine::Columns);
        }
        counted = line.parse::<u64>().is_ok();
        if !counted {
            return None;
        }
    }
    counted.then_some(FirstLine::Count)
}

fn is_comment(line: &[u8]) -> bool {
    line.starts_with(b"#") || line.starts_with(b"//")
}

fn is_row(line: &str) -> bool {
    let separator = Separator::of(line);
    let mut tokens = separator.split(line);
    (0..3).all(|_| tokens.next().is_some_and(|token| separator.value(token, "x", 0).is_ok()))
}

/// What stands between the values of a row.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Separator {
    Whitespace,
    Comma,
    Semicolon,
}

impl Separator {
    fn of(line: &str) -> Self {
        if line.contains(';') {
            return Self::Semicolon;
        }
        let words: Vec<&str> = line.split_ascii_whitespace().collect();
        let comma_between = words.iter().any(|word| word.starts_with(',') || word.ends_with(','));
        if line.contains(',') && (words.len() < 3 || comma_between) { Self::Comma } else { Self::Whitespace }
    }

    fn split(self, line: &str) -> impl Iterator<Item = &str> {
        line.split(move |c: char| match self {
            Self::Whitespace => c.is_ascii_whitespace(),
            Self::Comma => c == ',',
            Self::Semicolon => c == ';',
        })
        .map(str::trim_ascii)
        .filter(|token| !token.is_empty())
    }

    fn value(self, token: &str, field: &'static str, line: u64) -> Result<f64, DecodeError> {
        // 1.234,5 and 1,234.5 stay as they are and are refused: which mark is the decimal one is not known.
        let decimal_comma = self != Self::Comma && token.matches(',').count() == 1 && !token.contains('.');
        if decimal_comma { number(&token.replace(',', "."), field, line) } else { number(token, field, line) }
    }
}

/// Which columns hold what.
#[derive(Debug, Clone, Copy)]
struct Columns {
    xyz: [usize; 3],
    rgb: Option<[usize; 3]>,
    count: usize,
}

impl Columns {
    /// From a line of names.
    fn named(line: &str) -> Option<Self> {
        let names: Vec<String> = Separator::of(line)
            .split(line)
            .map(|name| name.trim_matches(['"', '\'']).to_ascii_lowercase())
            .collect();
        let find = |wanted: [&str; 2]| names.iter().position(|name| wanted.contains(&name.as_str()));
        let xyz = [find(["x"; 2])?, find(["y"; 2])?, find(["z"; 2])?];
        let rgb = match [find(["r", "red"]), find(["g", "green"]), find(["b", "blue"])] {
            [Some(r), Some(g), Some(b)] => Some([r, g, b]),
            _ => None,
        };
        Some(Self { xyz, rgb, count: names.len() })
    }

    /// By their number alone.
    fn usual(count: usize) -> Self {
        let rgb = match count {
            6 => Some([3, 4, 5]),
            7 => Some([4, 5, 6]),
            _ => None,
        };
        Self { xyz: [0, 1, 2], rgb, count }
    }
}

/// How rows are read, once the first one has shown it.
struct Rows {
    separator: Separator,
    columns: Columns,
    /// The first rows, while unnamed columns may or may not be colours.
    probe: Vec<([f64; 3], Option<[u8; 3]>)>,
    colors_decided: bool,
}

impl Rows {
    fn start(row: &str, named: Option<Columns>, line: u64) -> Result<Self, DecodeError> {
        let separator = Separator::of(row);
        let tokens: Vec<&str> = separator.split(row).collect();
        let named = named.filter(|columns| columns.count == tokens.len());
        let whole = |token: &&str| token.trim_start_matches(['-', '+']).bytes().all(|b| b.is_ascii_digit());
        if separator == Separator::Comma && named.is_none() && tokens.len() >= 6 && tokens.iter().all(whole) {
            return Err(DecodeError::AmbiguousCommas { line });
        }
        if tokens.len() < 3 {
            return Err(DecodeError::RowLength { line, found: tokens.len(), expected: 3 });
        }
        Ok(Self {
            separator,
            columns: named.unwrap_or_else(|| Columns::usual(tokens.len())),
            probe: Vec::new(),
            colors_decided: named.is_some(),
        })
    }

    /// Reads one row; gives it to `out`, or keeps it until the colours are decided.
    fn take(&mut self, row: &str, line: u64, declared: u64, out: &mut Collector) -> Result<(), DecodeError> {
        let tokens: Vec<&str> = self.separator.split(row).collect();
        let expected = self.columns.count;
        if tokens.len() != expected {
            return Err(DecodeError::RowLength { line, found: tokens.len(), expected });
        }
        let token = |at: usize| tokens.get(at).copied().unwrap_or_default();
        let value = |at: usize, field| self.separator.value(token(at), field, line);
        let [x, y, z] = self.columns.xyz;
        let position = [value(x, "x")?, value(y, "y")?, value(z, "z")?];
        let color = self.columns.rgb.and_then(|[r, g, b]| {
            Some([token(r).parse().ok()?, token(g).parse().ok()?, token(b).parse().ok()?])
        });
        if self.colors_decided {
            return out.push(position, color.unwrap_or_default());
        }
        self.probe.push((position, color));
        if self.probe.len() == PROBE_ROWS { self.decide_colors(declared, out) } else { Ok(()) }
    }

    /// Unnamed columns are colours when all rows so far hold bytes there, one of them above 1 (normals are not).
    fn decide_colors(&mut self, declared: u64, out: &mut Collector) -> Result<(), DecodeError> {
        if self.colors_decided {
            return Ok(());
        }
        self.colors_decided = true;
        let all = self.probe.iter().all(|(_, color)| color.is_some());
        let bright = self.probe.iter().filter_map(|(_, color)| *color).flatten().any(|channel| channel > 1);
        if !(all && bright) {
            self.columns.rgb = None;
        }
        out.expect(declared, self.columns.rgb.is_some())?;
        for (position, color) in std::mem::take(&mut self.probe) {
            out.push(position, color.unwrap_or_default())?;
        }
        Ok(())
    }
}

/// Reads all points of a text file.
pub(super) fn read(source: &mut Source<'_>, out: &mut Collector, format: Format) -> Result<(), DecodeError> {
    let mut buffer = Vec::new();
    let mut named = None;
    let mut rows: Option<Rows> = None;
    // Of PTS: the sum of the counts, and the rows that were read.
    let (mut declared, mut present) = (0u64, 0u64);
    loop {
        let start = source.offset;
        let Some(text) = source.next_text_line(&mut buffer)? else { break };
        let line = source.line;
        let text = text.trim_start_matches('\u{feff}').trim_ascii();
        if is_comment(text.as_bytes()) {
            if rows.is_none() {
                named = Columns::named(text.trim_start_matches(['#', '/', ' '])).or(named);
            }
            continue;
        }
        if format == Format::Pts && present == declared {
            let Ok(count) = text.parse::<u64>() else {
                return Err(DecodeError::ExcessData { declared, offset: start });
            };
            declared = declared.saturating_add(count);
            if rows.is_none() {
                out.expect(declared, false)?;
            }
            continue;
        }
        let rows = match &mut rows {
            Some(rows) => rows,
            None if named.is_none() && !is_row(text) && Columns::named(text).is_some() => {
                named = Columns::named(text);
                continue;
            }
            None => {
                let started = rows.insert(Rows::start(text, named, line)?);
                if started.colors_decided {
                    out.expect(declared, started.columns.rgb.is_some())?;
                }
                started
            }
        };
        let outcome = rows.take(text, line, declared, out);
        if let (Err(DecodeError::RowLength { found, expected, .. }), Format::Pts) = (&outcome, format) {
            // A row cut short at the very end of the file is a truncated file.
            if found < expected && source.next_text_line(&mut buffer)?.is_none() {
                break;
            }
        }
        outcome?;
        present += 1;
    }
    if let Some(rows) = &mut rows {
        rows.decide_colors(declared, out)?;
    }
    if present < declared {
        Err(DecodeError::Truncated { what: "points", declared, present })
    } else {
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::super::{DecodeOptions, Decoded, decode};
    use super::*;
    use crate::control::CancelToken;

    fn read(text: &str) -> Result<Decoded, DecodeError> {
        decode(&mut text.as_bytes(), &DecodeOptions::default(), &CancelToken::new())
    }

    #[test]
    fn every_separator_and_decimal_mark_gives_the_same_points() {
        for text in [
            "1.5 2.5 -3\n4 5 6\n",
            "\u{feff}1.5\t2.5\t-3\r\n\r\n4\t5\t6",
            "# a comment\n// x y z\n1.5,2.5,-3\n4,5,6\n",
            "1.5, 2.5, -3\n4, 5, 6\n",
            "1.5;2.5;-3;\n4;5;6;\n",
            "1,5;2,5;-3,0\n4;5;6\n",
            "1,5 2,5 -3\n4 5 6\n",
            "X;Y;Z\n1.5;2.5;-3\n4;5;6\n",
            "\"x\",\"y\",\"z\"\n1.5,2.5,-3\n4,5,6\n",
        ] {
            assert_eq!(read(text).unwrap().cloud.points, [[1.5, 2.5, -3.0], [4.0, 5.0, 6.0]], "{text}");
        }
    }

    #[test]
    fn commas_that_may_be_either_are_refused() {
        assert!(matches!(read("1,5,2,5,3,5\n"), Err(DecodeError::AmbiguousCommas { line: 1 })));
        assert!(read("x,y,z,r,g,b\n1,5,2,5,3,5\n").is_ok(), "names settle it");
        let error = read("1 2 3\n1.234,5 2 3\n").unwrap_err();
        assert!(matches!(error, DecodeError::Value { line: 2, field: "x", .. }), "{error}");
        assert!(error.to_string().contains("decimal comma"), "{error}");
    }

    #[test]
    fn colours_are_told_from_normals() {
        let colored = read("1 2 3 255 0 7\n4 5 6 0 0 0\n").unwrap().cloud;
        assert_eq!(colored.colors, [[255, 0, 7], [0, 0, 0]]);
        assert!(read("1 2 3 0 0 1\n4 5 6 0 1 0\n").unwrap().cloud.colors.is_empty());
        assert!(read("1 2 3 0.5 0.5 0.7\n").unwrap().cloud.colors.is_empty());
        let named = read("//Z Y X B G R\n3 2 1 30 20 10\n").unwrap().cloud;
        assert_eq!((named.points, named.colors), (vec![[1.0, 2.0, 3.0]], vec![[10, 20, 30]]));
    }

    #[test]
    fn pts_counts_are_held_to() {
        let decoded = read("2\n1 2 3 -1200 9 8 7\n4 5 6 30 1 2 3\n1\n7 8 9 0 4 5 6\n").unwrap();
        assert_eq!(decoded.format, Format::Pts);
        assert_eq!(decoded.cloud.len(), 3);
        assert_eq!(decoded.cloud.colors[0], [9, 8, 7]);
        for cut in ["3\n1 2 3\n4 5 6\n", "3\n1 2 3\n4 5 6\n7 8"] {
            let error = read(cut).unwrap_err();
            assert!(matches!(error, DecodeError::Truncated { declared: 3, present: 2, .. }), "{error}");
        }
        assert!(matches!(read("1\n1 2 3\n4 5 6\n"), Err(DecodeError::ExcessData { declared: 1, offset: 8 })));
        assert!(matches!(read("1000000000000000000\n1 2 3\n"), Err(DecodeError::TooManyPoints { .. })));
        assert!(matches!(read("0\n"), Err(DecodeError::NoPoints)));
    }

    #[test]
    fn a_broken_row_names_its_line() {
        assert!(matches!(
            read("1 2 3\n\n4 5\n"),
            Err(DecodeError::RowLength { line: 3, found: 2, expected: 3 })
        ));
        assert!(matches!(read("1 2 3\n4 five 6\n"), Err(DecodeError::Value { line: 2, field: "y", .. })));
        assert!(matches!(read("1 2 3\n4 5 \0\n"), Err(DecodeError::NotText { line: 2, offset: 6 })));
        assert_eq!(read("1 2 3\n-1.#IND 5 6\n").unwrap().dropped_non_finite, 1);
    }
}
