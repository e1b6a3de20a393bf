//! Poses as text, in the forms that other programs read and write, each with its own convention.
//!
//! | form | one pose | direction |
//! |---|---|---|
//! | TUM | `timestamp tx ty tz qx qy qz qw` | `model_from_scan` |
//! | KITTI | the upper 3x4 of the matrix, row-major, in one line | `model_from_scan` |
//! | Redwood log (3DMatch) | `i j n`, then a 4x4 matrix in four lines | maps points of j into i: `i_from_j` |
//! | Redwood info | `i j n`, then a 6x6 matrix in six lines | information of the row in the log |
//!
//! Uses [`Pose`]. Used by the exports and by the evaluation.

use std::fmt::Write as _;

use nalgebra::{Matrix6, Quaternion, UnitQuaternion, Vector3};

use super::{Pose, PoseError};

/// What is wrong with a text of poses. Lines count from 1.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum PoseTextError {
    /// Too few or too many values in a line.
    #[error("line {line} has {found} values, but {expected} are expected")]
    Length {
        /// The line.
        line: usize,
        /// Values in it.
        found: usize,
        /// Values it must have.
        expected: usize,
    },
    /// A word that is no finite number, or no index.
    #[error("line {line}: {word:?} is no {what}")]
    Word {
        /// The line.
        line: usize,
        /// The word, shortened.
        word: String,
        /// What it should be.
        what: &'static str,
    },
    /// A quaternion far from unit length.
    #[error("line {line}: the quaternion has length {length}, not 1")]
    Quaternion {
        /// The line.
        line: usize,
        /// Its length.
        length: f64,
    },
    /// A matrix that is no rigid motion.
    #[error("the pose that begins at line {line} is no rigid motion: {source}")]
    Pose {
        /// Where the matrix begins.
        line: usize,
        /// Why.
        source: PoseError,
    },
    /// The text ends within a matrix.
    #[error("the text ends within the matrix that begins at line {line}")]
    Unfinished {
        /// Where the matrix begins.
        line: usize,
    },
}

/// One block of a Redwood log: a motion between two scans.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LogEntry {
    /// The scan into whose frame points are mapped.
    pub i: u32,
    /// The scan whose points are mapped.
    pub j: u32,
    /// The third number of the header line: how many scans there are, by custom.
    pub n: u32,
    /// Maps points of scan j into the frame of scan i.
    pub i_from_j: Pose,
}

/// One block of a Redwood info file: the information matrix of a pair.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct InfoEntry {
    /// As in the log.
    pub i: u32,
    /// As in the log.
    pub j: u32,
    /// Order of the six: translation, then the vector part of the rotation's quaternion.
    pub information: Matrix6<f64>,
}

/// TUM text: a comment that names the scans, then a line a scan; the timestamp is the index of the name.
#[must_use]
pub fn to_tum<'a>(poses: impl IntoIterator<Item = (&'a str, Pose)>) -> String {
    let (mut names, mut lines) = (String::new(), String::new());
    for (index, (name, model_from_scan)) in poses.into_iter().enumerate() {
        let (t, q) = (model_from_scan.translation, model_from_scan.quaternion());
        // A name with a line break must not add a line.
        let name: String = name.chars().map(|c| if c.is_control() { ' ' } else { c }).collect();
        let _ = writeln!(names, "# {index} {name}");
        let _ = writeln!(
            lines,
            "{index} {:.9} {:.9} {:.9} {:.12} {:.12} {:.12} {:.12}",
            t.x, t.y, t.z, q.i, q.j, q.k, q.w
        );
    }
    format!("# timestamp tx ty tz qx qy qz qw (model_from_scan, metres)\n{names}{lines}")
}

/// Parses TUM text into (timestamp, `model_from_scan`).
///
/// # Errors
/// Names the line of a wrong number of values, a word that is no finite number, or a quaternion not of unit length
/// (within 1 %).
pub fn parse_tum(text: &str) -> Result<Vec<(f64, Pose)>, PoseTextError> {
    content_lines(text)
        .map(|(line, content)| {
            let [time, tx, ty, tz, qx, qy, qz, qw] = numbers(line, content)?;
            let q = Quaternion::new(qw, qx, qy, qz);
            if (q.norm() - 1.0).abs() > 0.01 {
                return Err(PoseTextError::Quaternion { line, length: q.norm() });
            }
            let pose = Pose::from_quaternion(UnitQuaternion::new_normalize(q), Vector3::new(tx, ty, tz));
            Ok((time, pose))
        })
        .collect()
}

/// KITTI text: twelve numbers a line, the upper 3x4 of each matrix.
#[must_use]
pub fn to_kitti(poses: impl IntoIterator<Item = Pose>) -> String {
    let mut text = String::new();
    for model_from_scan in poses {
        let rows = model_from_scan.to_rows();
        let words: Vec<String> = rows.iter().take(3).flatten().map(|x| format!("{x:.12e}")).collect();
        text.push_str(&words.join(" "));
        text.push('\n');
    }
    text
}

/// Parses KITTI text into `model_from_scan`, a pose a line.
///
/// # Errors
/// Names the line of a wrong number of values, a word that is no finite number, or a matrix that is no rigid motion.
pub fn parse_kitti(text: &str) -> Result<Vec<Pose>, PoseTextError> {
    content_lines(text)
        .map(|(line, content)| {
            let m: [f64; 12] = numbers(line, content)?;
            let [a, b, c, d, e, f, g, h, i, j, k, l] = m;
            pose(line, &[[a, b, c, d], [e, f, g, h], [i, j, k, l], [0.0, 0.0, 0.0, 1.0]])
        })
        .collect()
}

/// A Redwood log, as 3DMatch publishes its truth and reads estimates.
#[must_use]
pub fn to_log(entries: &[LogEntry]) -> String {
    let mut text = String::new();
    for entry in entries {
        let _ = writeln!(text, "{}\t{}\t{}", entry.i, entry.j, entry.n);
        for row in entry.i_from_j.to_rows() {
            let _ = writeln!(text, "{}", row.map(|x| format!("{x:.12e}")).join("\t"));
        }
    }
    text
}

/// Parses a Redwood log.
///
/// # Errors
/// Names the line of what is malformed.
pub fn parse_log(text: &str) -> Result<Vec<LogEntry>, PoseTextError> {
    blocks::<4>(text)?
        .into_iter()
        .map(|Block { line, i, j, n, rows }| Ok(LogEntry { i, j, n, i_from_j: pose(line + 1, &rows)? }))
        .collect()
}

/// A Redwood info file.
#[must_use]
pub fn to_info(entries: &[InfoEntry], n: u32) -> String {
    let mut text = String::new();
    for entry in entries {
        let _ = writeln!(text, "{}\t{}\t{n}", entry.i, entry.j);
        for row in entry.information.row_iter() {
            let words: Vec<String> = row.iter().map(|x| format!("{x:.12e}")).collect();
            let _ = writeln!(text, "{}", words.join("\t"));
        }
    }
    text
}

/// Parses a Redwood info file.
///
/// # Errors
/// Names the line of what is malformed.
pub fn parse_info(text: &str) -> Result<Vec<InfoEntry>, PoseTextError> {
    let entry = |Block { i, j, rows, .. }: Block<6>| InfoEntry {
        i,
        j,
        information: Matrix6::from_row_iterator(rows.into_iter().flatten()),
    };
    Ok(blocks::<6>(text)?.into_iter().map(entry).collect())
}

/// A header line `i j n` and a square matrix of `N` lines.
struct Block<const N: usize> {
    line: usize,
    i: u32,
    j: u32,
    n: u32,
    rows: [[f64; N]; N],
}

fn blocks<const N: usize>(text: &str) -> Result<Vec<Block<N>>, PoseTextError> {
    let mut lines = content_lines(text);
    let mut blocks = Vec::new();
    while let Some((line, header)) = lines.next() {
        let words: Vec<&str> = header.split_ascii_whitespace().collect();
        let &[i, j, n] = words.as_slice() else {
            return Err(PoseTextError::Length { line, found: words.len(), expected: 3 });
        };
        let index = |word: &str| word.parse().map_err(|_| bad_word(line, word, "index"));
        let mut block = Block { line, i: index(i)?, j: index(j)?, n: index(n)?, rows: [[0.0; N]; N] };
        for row in &mut block.rows {
            let (at, content) = lines.next().ok_or(PoseTextError::Unfinished { line })?;
            *row = numbers(at, content)?;
        }
        blocks.push(block);
    }
    Ok(blocks)
}

/// Lines that are neither blank nor comments, with their numbers.
fn content_lines(text: &str) -> impl Iterator<Item = (usize, &str)> {
    text.lines()
        .enumerate()
        .map(|(index, line)| (index + 1, line.trim()))
        .filter(|(_, line)| !line.is_empty() && !line.starts_with('#'))
}

fn numbers<const N: usize>(line: usize, content: &str) -> Result<[f64; N], PoseTextError> {
    let mut values = [0.0; N];
    let mut found = 0;
    for word in content.split_ascii_whitespace() {
        if let Some(value) = values.get_mut(found) {
            *value = word
                .parse()
                .ok()
                .filter(|x: &f64| x.is_finite())
                .ok_or_else(|| bad_word(line, word, "finite number"))?;
        }
        found += 1;
    }
    if found == N { Ok(values) } else { Err(PoseTextError::Length { line, found, expected: N }) }
}

fn bad_word(line: usize, word: &str, what: &'static str) -> PoseTextError {
    PoseTextError::Word { line, word: word.chars().take(40).collect(), what }
}

fn pose(line: usize, rows: &[[f64; 4]; 4]) -> Result<Pose, PoseTextError> {
    Pose::from_rows(rows).map_err(|source| PoseTextError::Pose { line, source })
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Rotation3;
    use std::f64::consts::FRAC_PI_2;

    /// A scanner that stands at (1, 2, 3) in the model and is turned left by 90 degrees: what it sees at its (1, 0, 0) is at
    /// (1, 3, 3) in the model.
    fn turned_left() -> Pose {
        Pose::new(Rotation3::new(Vector3::new(0.0, 0.0, FRAC_PI_2)), Vector3::new(1.0, 2.0, 3.0))
    }

    fn assert_near(a: &Pose, b: &Pose) {
        let (angle, distance) = a.difference(b);
        assert!(angle < 1e-8 && distance < 1e-8, "{angle} rad, {distance} m apart");
    }

    #[test]
    fn tum_has_the_scanner_in_the_model_and_w_last() {
        let text = "# a comment\n\n0.5 1 2 3 0 0 0.70710678 0.70710678\n";
        let poses = parse_tum(text).unwrap();
        assert_eq!(poses[0].0, 0.5);
        let seen = poses[0].1.transform(&Vector3::x());
        assert!((seen - Vector3::new(1.0, 3.0, 3.0)).norm() < 1e-8, "{seen}");
        let written = to_tum([("a\nb.ply", turned_left())]);
        assert_near(&parse_tum(&written).unwrap()[0].1, &turned_left());
        assert!(written.contains("# 0 a b.ply\n"), "{written}");
    }

    #[test]
    fn kitti_has_the_translation_in_every_fourth_place() {
        let text = "0 -1 0 1 1 0 0 2 0 0 1 3\n";
        assert_near(&parse_kitti(text).unwrap()[0], &turned_left());
        assert_near(&parse_kitti(&to_kitti([turned_left()])).unwrap()[0], &turned_left());
    }

    #[test]
    fn a_log_maps_the_second_scan_into_the_first() {
        let text = "0\t 1\t 60\n0 -1 0 1\n1 0 0 2\n0 0 1 3\n0 0 0 1\n";
        let entries = parse_log(text).unwrap();
        assert_eq!((entries[0].i, entries[0].j, entries[0].n), (0, 1, 60));
        let origin_of_j_in_i = entries[0].i_from_j.transform(&Vector3::zeros());
        assert!((origin_of_j_in_i - Vector3::new(1.0, 2.0, 3.0)).norm() < 1e-12);
        let again = parse_log(&to_log(&entries)).unwrap();
        assert_near(&again[0].i_from_j, &turned_left());
    }

    #[test]
    fn an_info_keeps_all_its_36_numbers_in_place() {
        let information = Matrix6::from_fn(|row, column| (row * 6 + column) as f64);
        let entry = InfoEntry { i: 3, j: 9, information };
        assert_eq!(parse_info(&to_info(&[entry], 60)).unwrap(), [entry]);
    }

    #[test]
    fn hostile_text_is_an_error_that_names_the_line() {
        assert_eq!(parse_tum("0 1 2"), Err(PoseTextError::Length { line: 1, found: 3, expected: 8 }));
        assert!(matches!(parse_tum("\n0 0 0 nan 0 0 0 1"), Err(PoseTextError::Word { line: 2, .. })));
        assert!(matches!(parse_tum("0 0 0 0 0 0 0 0"), Err(PoseTextError::Quaternion { line: 1, .. })));
        assert!(matches!(parse_kitti("1 0 0 0 0 1 0 0 0 0 -1 0"), Err(PoseTextError::Pose { line: 1, .. })));
        assert_eq!(parse_log("0 1 2\n1 0 0 0\n"), Err(PoseTextError::Unfinished { line: 1 }));
        assert!(matches!(parse_log("0 -1 2\n"), Err(PoseTextError::Word { line: 1, .. })));
        assert!(matches!(parse_info("0 1 2\n1 0 0 0\n"), Err(PoseTextError::Length { line: 2, .. })));
    }
}
