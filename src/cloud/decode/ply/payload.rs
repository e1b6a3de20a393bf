//! The records of a PLY file.

use ply_rs_bw::ply::Encoding;

use super::super::DecodeError;
use super::super::collector::Collector;
use super::super::records::read_records;
use super::super::scalar::Scalar;
use super::super::source::{Source, number};
use super::ROLES;
use super::header::{Element, Shape};

/// Position and colour of the vertex being read.
type Values = [f64; 6];

/// Passes over an element before the vertices.
pub(super) fn skip(
    source: &mut Source<'_>,
    element: &Element,
    encoding: Encoding,
) -> Result<(), DecodeError> {
    if element.properties.is_empty() {
        // Records without properties take no room, however many are declared.
        return Ok(());
    }
    let truncated = |present| DecodeError::Truncated {
        what: "records of an element before the vertices",
        declared: element.count,
        present,
    };
    let big_endian = match encoding {
        Encoding::Ascii => {
            let mut line = Vec::new();
            for present in 0..element.count {
                source.next_text_line(&mut line)?.ok_or(truncated(present))?;
            }
            return Ok(());
        }
        Encoding::BinaryBigEndian => true,
        Encoding::BinaryLittleEndian => false,
    };
    if let Some(stride) = element.stride() {
        let skipped = source.skip(stride.saturating_mul(element.count))?;
        let present = skipped / stride.max(1);
        return if present < element.count { Err(truncated(present)) } else { Ok(()) };
    }
    for present in 0..element.count {
        if walk(source, element, big_endian, &mut [0.0; 6])?.is_none() {
            return Err(truncated(present));
        }
    }
    Ok(())
}

/// Reads the vertices. `last` says that the header declares nothing after them.
pub(super) fn read(
    source: &mut Source<'_>,
    vertex: &Element,
    encoding: Encoding,
    last: bool,
    out: &mut Collector,
) -> Result<(), DecodeError> {
    match encoding {
        Encoding::Ascii => ascii(source, vertex, last, out),
        Encoding::BinaryLittleEndian => binary(source, vertex, false, last, out),
        Encoding::BinaryBigEndian => binary(source, vertex, true, last, out),
    }
}

fn ascii(
    source: &mut Source<'_>,
    vertex: &Element,
    last: bool,
    out: &mut Collector,
) -> Result<(), DecodeError> {
    let declared = vertex.count;
    let mut line = Vec::new();
    for present in 0..declared {
        let truncated = DecodeError::Truncated { what: "points", declared, present };
        let Some(row) = source.next_text_line(&mut line)? else { return Err(truncated) };
        let line_number = source.line;
        let mut values = [0.0; 6];
        let (found, expected) = ascii_row(row, vertex, line_number, &mut values)?;
        if found != expected {
            // A row cut short at the very end of the file is a truncated file.
            let at_end = found < expected && source.next_text_line(&mut line)?.is_none();
            let row_length = DecodeError::RowLength { line: line_number, found, expected };
            return Err(if at_end { truncated } else { row_length });
        }
        push(out, &values)?;
    }
    let offset = source.offset;
    if last && source.next_text_line(&mut line)?.is_some() {
        return Err(DecodeError::ExcessData { declared, offset });
    }
    Ok(())
}

/// Reads one row. Returns how many values it has and how many it should have.
fn ascii_row(
    row: &str,
    vertex: &Element,
    line: u64,
    values: &mut Values,
) -> Result<(usize, usize), DecodeError> {
    let mut expected = vertex.properties.len();
    let mut tokens = row.split_ascii_whitespace();
    for property in &vertex.properties {
        let Some(token) = tokens.next() else { break };
        match (property.shape, property.role) {
            (Shape::Scalar(_), Some(role)) => {
                let (field, _) = ROLES.get(role).copied().unwrap_or_default();
                if let Some(value) = values.get_mut(role) {
                    *value = number(token, field, line)?;
                }
            }
            (Shape::Scalar(_), None) => {}
            (Shape::List { .. }, _) => {
                let length = token.parse::<u32>().map_err(|_| DecodeError::Value {
                    line,
                    field: "a list length",
                    value: token.chars().take(40).collect(),
                    hint: "",
                })? as usize;
                expected += length;
                if length > 0 {
                    tokens.nth(length - 1);
                }
            }
        }
    }
    Ok((row.split_ascii_whitespace().count(), expected))
}

fn binary(
    source: &mut Source<'_>,
    vertex: &Element,
    big_endian: bool,
    last: bool,
    out: &mut Collector,
) -> Result<(), DecodeError> {
    let declared = vertex.count;
    let Some(stride) = vertex.stride() else {
        for present in 0..declared {
            let mut values = [0.0; 6];
            walk(source, vertex, big_endian, &mut values)?.ok_or(DecodeError::Truncated {
                what: "points",
                declared,
                present,
            })?;
            push(out, &values)?;
        }
        return Ok(());
    };
    let mut slots: Vec<(usize, usize, Scalar)> = Vec::new();
    let mut offset = 0;
    for property in &vertex.properties {
        if let Shape::Scalar(scalar) = property.shape {
            slots.extend(property.role.map(|role| (role, offset, scalar)));
            offset += scalar.size();
        }
    }
    read_records(source, declared, stride, last, |record| {
        let mut values = [0.0; 6];
        for &(role, offset, scalar) in &slots {
            if let Some(value) = values.get_mut(role) {
                *value = scalar.read(record, offset, big_endian);
            }
        }
        push(out, &values)
    })
}

/// Reads one binary record with lists in it, property by property. `None` where the file ends in it.
fn walk(
    source: &mut Source<'_>,
    element: &Element,
    big_endian: bool,
    values: &mut Values,
) -> Result<Option<()>, DecodeError> {
    let scalar = |source: &mut Source<'_>, scalar: Scalar| -> Result<Option<f64>, DecodeError> {
        let mut bytes = [0; 8];
        let filled = source.fill(bytes.get_mut(..scalar.size()).unwrap_or_default())?;
        Ok((filled == scalar.size()).then(|| scalar.read(&bytes, 0, big_endian)))
    };
    for property in &element.properties {
        match property.shape {
            Shape::Scalar(kind) => {
                let Some(value) = scalar(source, kind)? else { return Ok(None) };
                if let Some(slot) = property.role.and_then(|role| values.get_mut(role)) {
                    *slot = value;
                }
            }
            Shape::List { count, item } => {
                let Some(length) = scalar(source, count)? else { return Ok(None) };
                if !(length >= 0.0 && length.fract() == 0.0) {
                    return Err(DecodeError::Contradiction {
                        reason: format!(
                            "a list {:?} of {length} items before byte {}",
                            property.name, source.offset
                        ),
                    });
                }
                // A float that is too large saturates, and no file is that long.
                let bytes = (length as u64).saturating_mul(item.size() as u64);
                if source.skip(bytes)? < bytes {
                    return Ok(None);
                }
            }
        }
    }
    Ok(Some(()))
}

fn push(out: &mut Collector, &[x, y, z, red, green, blue]: &Values) -> Result<(), DecodeError> {
    // `as` saturates: a colour out of 0..=255 becomes the nearest one.
    out.push([x, y, z], [red as u8, green as u8, blue as u8])
}
