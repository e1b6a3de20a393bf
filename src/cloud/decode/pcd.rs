//! PCD: ascii, binary, `binary_compressed`.
//!
//! `pcd-rs` reads the header, from bytes that are bounded here; it allocates the declared sizes of a compressed payload
//! and overflows on large counts, so the payload is read here.

use pcd_rs::metas::{DataKind, FieldDef, PcdMeta};

use super::collector::Collector;
use super::records::{MAX_RECORD_BYTES, read_records};
use super::scalar::{Scalar, array};
use super::source::{Source, is_number_text, number};
use super::{DecodeError, Format, lzf};

const MAX_HEADER_BYTES: u64 = 64 * 1024;

/// One field that is read: its scalar type, and where it is.
#[derive(Debug, Clone, Copy)]
struct Slot {
    scalar: Scalar,
    /// Byte offset in a record.
    offset: usize,
    /// Index among the values of a row.
    column: usize,
}

/// Which fields hold a point.
struct Layout {
    xyz: [Slot; 3],
    /// Packed colour: the bits 0x00RRGGBB, often stored as a float.
    rgb: Option<Slot>,
    /// Bytes of a record.
    stride: u64,
    /// Values of a row.
    columns: usize,
}

/// Reads all points of a PCD file; returns where its VIEWPOINT stands, in the file's unit, unless it is the default.
pub(super) fn read(source: &mut Source<'_>, out: &mut Collector) -> Result<Option<[f64; 3]>, DecodeError> {
    let meta = header(source)?;
    if meta.width.checked_mul(meta.height) != Some(meta.num_points) {
        let reason =
            format!("WIDTH {} times HEIGHT {} is not POINTS {}", meta.width, meta.height, meta.num_points);
        return Err(DecodeError::Contradiction { reason });
    }
    let layout = Layout::of(&meta.field_defs.fields)?;
    out.expect(meta.num_points, layout.rgb.is_some())?;
    match meta.data {
        DataKind::Ascii => ascii(source, &layout, meta.num_points, out)?,
        DataKind::Binary => {
            read_records(source, meta.num_points, layout.stride, true, |record| {
                let slots = layout.xyz.map(|slot| slot.scalar.read(record, slot.offset, false));
                let rgb = layout.rgb.map_or(0, |slot| packed(record, slot.offset));
                out.push(slots, unpack(rgb))
            })?;
        }
        DataKind::BinaryCompressed => compressed(source, &layout, meta.num_points, out)?,
    }
    viewpoint(&meta)
}

/// Takes the header, up to and including its DATA line.
fn header(source: &mut Source<'_>) -> Result<PcdMeta, DecodeError> {
    let (mut text, mut line) = (Vec::new(), Vec::new());
    loop {
        if !source.next_line(&mut line)? {
            return Err(malformed(source.line, "the file ends before the DATA line"));
        }
        if source.offset > MAX_HEADER_BYTES {
            return Err(DecodeError::HeaderTooLong { format: Format::Pcd, limit_bytes: MAX_HEADER_BYTES });
        }
        if line.trim_ascii().starts_with(b"#") {
            // Comments need not be UTF-8, which the library insists on.
            line.clear();
        }
        text.extend_from_slice(&line);
        text.push(b'\n');
        let is_data = line.split(u8::is_ascii_whitespace).find(|word| !word.is_empty());
        if is_data.is_some_and(|word| word.eq_ignore_ascii_case(b"DATA")) {
            return PcdMeta::from_reader(text.as_slice()).map_err(|error| match error {
                pcd_rs::error::Error::ParseError { desc, .. } => malformed(source.line, &desc),
                other => malformed(source.line, &other.to_string()),
            });
        }
    }
}

fn malformed(line: u64, reason: &str) -> DecodeError {
    DecodeError::Header { format: Format::Pcd, line, reason: reason.chars().take(200).collect() }
}

impl Layout {
    fn of(fields: &[FieldDef]) -> Result<Self, DecodeError> {
        let (mut stride, mut columns) = (0u64, 0u64);
        let mut places = Vec::with_capacity(fields.len());
        for field in fields {
            places.push((field, stride, columns));
            let bytes = field.count.saturating_mul(field.kind.byte_size() as u64);
            stride = stride.saturating_add(bytes);
            columns = columns.saturating_add(field.count);
        }
        if stride > MAX_RECORD_BYTES {
            return Err(DecodeError::RecordTooLarge { bytes: stride, limit: MAX_RECORD_BYTES });
        }
        let find = |names: &[&str], needed: &'static str| {
            let &(field, offset, column) = places
                .iter()
                .find(|(field, ..)| names.iter().any(|name| field.name.eq_ignore_ascii_case(name)))
                .ok_or(DecodeError::MissingField { format: Format::Pcd, field: needed })?;
            if field.count != 1 {
                let found = format!("{} values", field.count);
                return Err(DecodeError::FieldType {
                    field: field.name.clone(),
                    found,
                    expected: "one value",
                });
            }
            // Both are at most MAX_RECORD_BYTES.
            Ok(Slot { scalar: field.kind.into(), offset: offset as usize, column: column as usize })
        };
        let xyz = [find(&["x"], "x")?, find(&["y"], "y")?, find(&["z"], "z")?];
        let rgb = find(&["rgb", "rgba"], "rgb").ok().filter(|slot| slot.scalar.size() == 4);
        Ok(Self { xyz, rgb, stride, columns: columns as usize })
    }
}

fn ascii(
    source: &mut Source<'_>,
    layout: &Layout,
    declared: u64,
    out: &mut Collector,
) -> Result<(), DecodeError> {
    let (mut line, expected) = (Vec::new(), layout.columns);
    for present in 0..declared {
        let truncated = DecodeError::Truncated { what: "points", declared, present };
        let Some(row) = source.next_text_line(&mut line)? else { return Err(truncated) };
        let tokens: Vec<&str> = row.split_ascii_whitespace().collect();
        let (found, at) = (tokens.len(), source.line);
        if found != expected {
            let at_end = found < expected && source.next_text_line(&mut line)?.is_none();
            return Err(if at_end {
                truncated
            } else {
                DecodeError::RowLength { line: at, found, expected }
            });
        }
        let value =
            |slot: Slot, field| number(tokens.get(slot.column).copied().unwrap_or_default(), field, at);
        let [x, y, z] = layout.xyz;
        let position = [value(x, "x")?, value(y, "y")?, value(z, "z")?];
        let rgb =
            layout.rgb.map(|slot| value(slot, "rgb").map(|v| bits_of_text(v, slot.scalar))).transpose()?;
        out.push(position, unpack(rgb.unwrap_or(0)))?;
    }
    let offset = source.offset;
    match source.next_text_line(&mut line)? {
        Some(_) => Err(DecodeError::ExcessData { declared, offset }),
        None => Ok(()),
    }
}

/// Reads a block of columns (all x, then all y, …) behind its two sizes.
fn compressed(
    source: &mut Source<'_>,
    layout: &Layout,
    declared: u64,
    out: &mut Collector,
) -> Result<(), DecodeError> {
    let sizes =
        source.array::<8>()?.ok_or(DecodeError::Truncated { what: "points", declared, present: 0 })?;
    let compressed_bytes = u64::from(u32::from_le_bytes(array(&sizes, false)));
    let plain_bytes = u64::from(u32::from_le_bytes(array(sizes.get(4..).unwrap_or_default(), false)));
    let needed = declared.saturating_mul(layout.stride);
    let start = source.offset;
    let mut data = Vec::new();
    let present = source.append(compressed_bytes, &mut data)?;
    if is_number_text(&sizes) {
        return Err(DecodeError::TextForBinary { offset: start - 8 });
    }
    if plain_bytes != needed {
        let reason = format!(
            "the compressed block unfolds to {plain_bytes} bytes, but {declared} points of {} bytes take {needed}",
            layout.stride
        );
        return Err(DecodeError::Contradiction { reason });
    }
    if present < compressed_bytes {
        return Err(DecodeError::Truncated {
            what: "bytes of compressed data",
            declared: compressed_bytes,
            present,
        });
    }
    let columns = lzf::decompress(&data, plain_bytes)?;
    drop(data);
    // The sizes agree, so `declared` records are in memory and its products fit in usize.
    for index in 0..declared as usize {
        let place = |slot: Slot| slot.offset * declared as usize + index * slot.scalar.size();
        let position = layout.xyz.map(|slot| slot.scalar.read(&columns, place(slot), false));
        let rgb = layout.rgb.map_or(0, |slot| packed(&columns, place(slot)));
        out.push(position, unpack(rgb))?;
    }
    Ok(())
}

/// Where the sensor stood, unless VIEWPOINT is the default or absent.
fn viewpoint(meta: &PcdMeta) -> Result<Option<[f64; 3]>, DecodeError> {
    let v = &meta.viewpoint;
    if [v.tx, v.ty, v.tz, v.qw, v.qx, v.qy, v.qz].iter().any(|x| !x.is_finite()) {
        return Err(DecodeError::FieldType {
            field: "VIEWPOINT".to_owned(),
            found: "not finite".to_owned(),
            expected: "seven finite numbers",
        });
    }
    Ok((*v != pcd_rs::metas::ViewPoint::default()).then_some([v.tx, v.ty, v.tz]))
}

/// The four bytes of a packed colour, whatever their declared type.
fn packed(bytes: &[u8], offset: usize) -> u32 {
    u32::from_le_bytes(array(bytes.get(offset..).unwrap_or_default(), false))
}

/// The bits of a packed colour written as text: an integer, or a float whose bits are meant.
fn bits_of_text(value: f64, scalar: Scalar) -> u32 {
    match scalar {
        Scalar::F32 => (value as f32).to_bits(),
        Scalar::I32 => (value as i32).cast_unsigned(),
        _ => value as u32,
    }
}

fn unpack(rgb: u32) -> [u8; 3] {
    let [_, red, green, blue] = rgb.to_be_bytes();
    [red, green, blue]
}

#[cfg(test)]
mod tests {
    use super::super::{DecodeOptions, Decoded, decode};
    use super::*;
    use crate::control::CancelToken;

    fn read(bytes: &[u8]) -> Result<Decoded, DecodeError> {
        decode(&mut &*bytes, &DecodeOptions::default(), &CancelToken::new())
    }

    fn header(points: u64, data: &str) -> String {
        format!(
            "# .PCD v0.7\nVERSION 0.7\nFIELDS rgb x _ y z\nSIZE 4 4 1 8 4\nTYPE U F U F F\nCOUNT 1 1 3 1 1\nWIDTH {points}\n\
             HEIGHT 1\nVIEWPOINT 0.5 0 -1 1 0 0 0\nPOINTS {points}\nDATA {data}\n"
        )
    }

    const POINTS: [(u32, f32, f64, f32); 2] =
        [(0x00ff_8001, 1.0, 2.0, 3.0), (0xff01_0203, -4.0, 0.25, f32::NAN)];

    fn expected(decoded: &Decoded) {
        assert_eq!(decoded.cloud.points, [[1.0, 2.0, 3.0]]);
        assert_eq!(decoded.cloud.colors, [[0xff, 0x80, 0x01]]);
        assert_eq!(decoded.dropped_non_finite, 1);
        assert_eq!(decoded.sensor_position, Some([0.5, 0.0, -1.0]));
        assert_eq!(decoded.format, Format::Pcd);
    }

    #[test]
    fn ascii_binary_and_compressed_hold_the_same_points() {
        let mut ascii = header(2, "ascii").into_bytes();
        ascii.extend_from_slice(b"16744449 1 0 0 0 2 3\n4278255107 -4 0 0 0 .25 nan\n");
        expected(&read(&ascii).unwrap());

        let mut binary = header(2, "binary").into_bytes();
        for (rgb, x, y, z) in POINTS {
            binary.extend_from_slice(
                &[&rgb.to_le_bytes()[..], &x.to_le_bytes(), &[0; 3], &y.to_le_bytes(), &z.to_le_bytes()]
                    .concat(),
            );
        }
        expected(&read(&binary).unwrap());

        let mut columns = Vec::new();
        columns.extend(POINTS.iter().flat_map(|p| p.0.to_le_bytes()));
        columns.extend(POINTS.iter().flat_map(|p| p.1.to_le_bytes()));
        columns.extend([0; 6]);
        columns.extend(POINTS.iter().flat_map(|p| p.2.to_le_bytes()));
        columns.extend(POINTS.iter().flat_map(|p| p.3.to_le_bytes()));
        let literal: Vec<u8> =
            columns.chunks(32).flat_map(|run| [&[run.len() as u8 - 1][..], run].concat()).collect();
        let mut file = header(2, "binary_compressed").into_bytes();
        file.extend_from_slice(&(literal.len() as u32).to_le_bytes());
        file.extend_from_slice(&(columns.len() as u32).to_le_bytes());
        file.extend_from_slice(&literal);
        expected(&read(&file).unwrap());

        let body = file.len() - literal.len();
        file[body] = 0xff;
        assert!(matches!(read(&file), Err(DecodeError::CorruptLzf { .. })));
        file[body - 4] ^= 1;
        assert!(matches!(read(&file), Err(DecodeError::Contradiction { .. })));
    }

    #[test]
    fn files_of_the_reference_library_are_read() {
        use pcd_rs::metas::{Schema, ValueKind, ViewPoint};
        use pcd_rs::record::{DynRecord, Field};
        use pcd_rs::writer::WriterInit;
        for data_kind in [DataKind::Ascii, DataKind::Binary, DataKind::BinaryCompressed] {
            let mut file = std::io::Cursor::new(Vec::new());
            let schema = Some(Schema::from_iter(["x", "y", "z"].map(|name| (name, ValueKind::F32, 1))));
            let viewpoint = ViewPoint::default();
            let init = WriterInit { height: 1, width: 500, viewpoint, data_kind, schema, version: None };
            let mut writer = init.build_from_writer::<DynRecord, _>(&mut file).unwrap();
            for i in 0..500u16 {
                let row = [f32::from(i) / 8.0, 1.5, -2.0];
                writer.push(&DynRecord(row.map(|v| Field::F32(vec![v])).to_vec())).unwrap();
            }
            writer.finish().unwrap();
            let decoded = read(file.get_ref()).unwrap();
            assert_eq!(decoded.cloud.len(), 500, "{data_kind:?}");
            assert_eq!(decoded.cloud.points[499], [62.375, 1.5, -2.0]);
            assert_eq!(decoded.sensor_position, None);
        }
    }

    #[test]
    fn a_header_that_lies_about_its_size_is_refused_before_the_payload() {
        let huge = header(1_000_000_000_000_000_000, "binary");
        assert!(matches!(read(huge.as_bytes()), Err(DecodeError::TooManyPoints { .. })));
        let wide = huge.replace("COUNT 1 1 3 1 1", "COUNT 1 1 18446744073709551615 1 1");
        assert!(matches!(read(wide.as_bytes()), Err(DecodeError::RecordTooLarge { .. })));
        let mismatch = header(5, "binary").replace("WIDTH 5", "WIDTH 4");
        assert!(matches!(read(mismatch.as_bytes()), Err(DecodeError::Contradiction { .. })));
        let without = header(5, "ascii").replace(" z\n", " zz\n");
        assert!(matches!(read(without.as_bytes()), Err(DecodeError::MissingField { field: "z", .. })));
    }
}
