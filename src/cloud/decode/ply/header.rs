//! The header of a PLY file, read by `ply-rs-bw` after the traps are out of its way.
//!
//! The library reads lines of any length, refuses property names that real programs write (`scalar_C2C[<0.5]`) and
//! comments in Latin-1, and lets a name that is declared twice replace the first one, which shifts every record. So the
//! lines are taken here, with a limit; comments are dropped, names checked and replaced by numbers.

use ply_rs_bw::parser::{Parser, Reader};
use ply_rs_bw::ply::{DefaultElement, Encoding, PropertyType};

use super::super::scalar::Scalar;
use super::super::source::Source;
use super::super::{DecodeError, Format};

const MAX_HEADER_BYTES: u64 = 1 << 20;

/// The declarations that matter.
pub(super) struct Header {
    pub encoding: Encoding,
    /// In the order of the payload.
    pub elements: Vec<Element>,
}

/// A kind of records.
pub(super) struct Element {
    pub name: String,
    /// As declared: not to be trusted.
    pub count: u64,
    pub properties: Vec<Property>,
}

/// One value, or list of values, of a record.
pub(super) struct Property {
    pub name: String,
    pub shape: Shape,
    /// Which of the six values of a point this is.
    pub role: Option<usize>,
}

/// How a property is stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Shape {
    Scalar(Scalar),
    List { count: Scalar, item: Scalar },
}

impl Element {
    /// Bytes of one binary record, or `None` when it holds lists.
    pub fn stride(&self) -> Option<u64> {
        self.properties.iter().try_fold(0, |sum, property| match property.shape {
            Shape::Scalar(scalar) => Some(sum + scalar.size() as u64),
            Shape::List { .. } => None,
        })
    }
}

/// Takes the header, up to and including its `end_header` line.
pub(super) fn read(source: &mut Source<'_>) -> Result<Header, DecodeError> {
    let (text, names) = collect(source)?;
    let parsed =
        Parser::<DefaultElement>::new().read_header(&mut Reader::new(text.as_bytes())).map_err(|error| {
            malformed(error.line().map_or(source.line, |line| line as u64), &error.to_string())
        })?;
    // Elements and properties come back in order, under the numbers they were given.
    let name_of =
        |number: &str| number.get(1..).and_then(|n| n.parse::<usize>().ok()).and_then(|n| names.get(n));
    let elements = parsed
        .elements
        .values()
        .map(|element| Element {
            name: name_of(&element.name).cloned().unwrap_or_default(),
            count: element.count as u64,
            properties: element
                .properties
                .values()
                .map(|property| Property {
                    name: name_of(&property.name).cloned().unwrap_or_default(),
                    shape: match &property.data_type {
                        PropertyType::Scalar(scalar) => Shape::Scalar(scalar.into()),
                        PropertyType::List(count, item) => {
                            Shape::List { count: count.into(), item: item.into() }
                        }
                    },
                    role: None,
                })
                .collect(),
        })
        .collect();
    Ok(Header { encoding: parsed.encoding, elements })
}

/// The header lines with comments emptied and names replaced by `_0`, `_1`, …, and the names.
fn collect(source: &mut Source<'_>) -> Result<(String, Vec<String>), DecodeError> {
    let (mut text, mut names, mut line) = (String::new(), Vec::new(), Vec::new());
    let (mut elements, mut properties) = (Vec::<String>::new(), Vec::<String>::new());
    loop {
        if !source.next_line(&mut line)? {
            return Err(malformed(source.line, "the file ends before end_header"));
        }
        if source.offset > MAX_HEADER_BYTES {
            return Err(DecodeError::HeaderTooLong { format: Format::Ply, limit_bytes: MAX_HEADER_BYTES });
        }
        let trimmed = line.trim_ascii();
        if trimmed.is_empty() || trimmed.starts_with(b"comment") || trimmed.starts_with(b"obj_info") {
            text.push_str("comment\n");
            continue;
        }
        let content =
            std::str::from_utf8(trimmed).map_err(|_| malformed(source.line, "the line is not text"))?;
        let mut words: Vec<&str> = content.split_ascii_whitespace().collect();
        let number = format!("_{}", names.len());
        match *words.as_slice() {
            ["element", name, _] => {
                if elements.iter().any(|known| known == name) {
                    return Err(malformed(source.line, &format!("the element {name:?} is declared twice")));
                }
                elements.push(name.to_owned());
                properties.clear();
                names.push(name.to_owned());
                words[1] = &number;
            }
            ["property", .., name] => {
                if properties.iter().any(|known| known == name) {
                    return Err(malformed(source.line, &format!("the property {name:?} is declared twice")));
                }
                properties.push(name.to_owned());
                names.push(name.to_owned());
                let last = words.len() - 1;
                words[last] = &number;
            }
            _ => {}
        }
        text.push_str(&words.join(" "));
        text.push('\n');
        if content == "end_header" {
            return Ok((text, names));
        }
    }
}

fn malformed(line: u64, reason: &str) -> DecodeError {
    // The library's messages repeat the whole line and span several.
    let reason = reason.lines().next().unwrap_or_default().chars().take(200).collect();
    DecodeError::Header { format: Format::Ply, line, reason }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::control::CancelToken;

    fn header(text: &str) -> Result<Header, DecodeError> {
        let cancel = CancelToken::new();
        read(&mut Source::new(text.as_bytes().to_vec(), &mut &b""[..], &cancel))
    }

    #[test]
    fn a_name_with_a_space_is_refused() {
        let file = "ply\nformat ascii 1.0\n\nobj_info x\nelement vertex 1\nproperty short x y\nend_header\n";
        assert!(matches!(header(file), Err(DecodeError::Header { .. })));
    }

    #[test]
    fn elements_come_in_the_order_of_the_payload() {
        let header = header(
            "ply\nformat binary_big_endian 1.0\nelement b 1\nproperty list uint8 float64 q\nproperty int odd.name\n\
             element a 18446744073709551615\nproperty short x\nend_header\n",
        )
        .unwrap();
        let names: Vec<&str> = header.elements.iter().map(|e| e.name.as_str()).collect();
        assert_eq!(names, ["b", "a"]);
        assert_eq!(header.elements[0].properties[1].name, "odd.name");
        assert_eq!(header.elements[0].stride(), None);
        assert_eq!((header.elements[1].count, header.elements[1].stride()), (u64::MAX, Some(2)));
    }

    #[test]
    fn malformed_headers_name_the_line() {
        for (text, line) in [
            ("ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float x\nend_header\n", 5),
            ("ply\nformat ascii 1.0\nelement vertex 1\nelement vertex 2\nend_header\n", 4),
            ("ply\nformat ascii 1.0\nelement vertex -3\nend_header\n", 3),
            ("ply\nformat ascii 1.0\nelement vertex 99999999999999999999999\nend_header\n", 3),
            ("ply\nproperty float x\nend_header\n", 2),
            ("ply\nformat ascii 1.0\n", 2),
        ] {
            match header(text).err() {
                Some(DecodeError::Header { line: at, .. }) => assert_eq!(at, line, "{text}"),
                other => panic!("{text}: {other:?}"),
            }
        }
    }
}
