//! PLY: ascii, binary little endian, binary big endian.
//!
//! Elements before `vertex` are passed over, elements after it are not read. Lists are passed over wherever they are.

mod header;
mod payload;

use super::collector::Collector;
use super::scalar::Scalar;
use super::source::Source;
use super::{DecodeError, Format};
use header::{Element, Property, Shape};

/// What the six values of a point are, in the order in which a reader gathers them.
const ROLES: [(&str, &[&str]); 6] = [
    ("x", &["x"]),
    ("y", &["y"]),
    ("z", &["z"]),
    ("red", &["red", "r", "diffuse_red"]),
    ("green", &["green", "g", "diffuse_green"]),
    ("blue", &["blue", "b", "diffuse_blue"]),
];

/// Reads all vertices of a PLY file.
pub(super) fn read(source: &mut Source<'_>, out: &mut Collector) -> Result<(), DecodeError> {
    let mut header = header::read(source)?;
    let missing = |field| DecodeError::MissingField { format: Format::Ply, field };
    let at = header.elements.iter().position(|e| e.name == "vertex").ok_or(missing("element vertex"))?;
    let last = header.elements.iter().skip(at + 1).all(|e| e.count == 0);
    let before: Vec<Element> = header.elements.drain(..at).collect();
    let Some(vertex) = header.elements.first_mut() else { return Err(missing("element vertex")) };
    let with_colors = assign_roles(&mut vertex.properties)?;
    out.expect(vertex.count, with_colors)?;
    for element in &before {
        payload::skip(source, element, header.encoding)?;
    }
    payload::read(source, vertex, header.encoding, last, out)
}

/// Marks which property holds what. Returns whether all three colours are there as bytes; colours of other types are left out.
fn assign_roles(properties: &mut [Property]) -> Result<bool, DecodeError> {
    let find = |properties: &[Property], names: &[&str]| {
        properties.iter().position(|p| names.iter().any(|name| p.name.eq_ignore_ascii_case(name)))
    };
    for (role, (field, names)) in ROLES.iter().enumerate().take(3) {
        let at = find(properties, names).ok_or(DecodeError::MissingField { format: Format::Ply, field })?;
        let Some(property) = properties.get_mut(at) else { continue };
        if let Shape::List { .. } = property.shape {
            let found = "a list".to_owned();
            return Err(DecodeError::FieldType { field: (*field).to_owned(), found, expected: "a scalar" });
        }
        property.role = Some(role);
    }
    let colors: Vec<usize> = ROLES
        .iter()
        .skip(3)
        .filter_map(|(_, names)| find(properties, names))
        .filter(|&at| properties.get(at).is_some_and(|p| p.shape == Shape::Scalar(Scalar::U8)))
        .collect();
    if colors.len() != 3 {
        return Ok(false);
    }
    for (channel, at) in colors.into_iter().enumerate() {
        if let Some(property) = properties.get_mut(at) {
            property.role = Some(3 + channel);
        }
    }
    Ok(true)
}

#[cfg(test)]
mod tests {
    use std::fmt::Write as _;

    use super::super::{DecodeError, DecodeOptions, Decoded, Format, decode};
    use crate::control::CancelToken;

    fn read(bytes: &[u8]) -> Result<Decoded, DecodeError> {
        decode(&mut &*bytes, &DecodeOptions::default(), &CancelToken::new())
    }

    fn with_payload(header: &str, payload: &[u8]) -> Vec<u8> {
        [header.as_bytes(), payload].concat()
    }

    #[test]
    fn ascii_points_with_colours_lists_and_other_elements_are_read() {
        let file = "ply\r\nformat ascii 1.0\r\ncomment caf\u{e9}\r\nelement camera 2\r\nproperty list uchar int ids\r\n\
            element vertex 2\r\nproperty uchar red\r\nproperty list uchar float w\r\nproperty double x\r\nproperty float y\r\n\
            property float z\r\nproperty float scalar_C2C[<0.5]\r\nproperty uchar green\r\nproperty uchar blue\r\n\
            element face 1\r\nproperty list uchar int vertex_indices\r\nend_header\r\n\
            2 7 8\r\n0\r\n255 1 0.5 1.25 2 3 9 0 10\r\n1 0 -4 5e-1 6 9 2 3\r\n3 0 1 0\r\n";
        let decoded = read(file.as_bytes()).unwrap();
        assert_eq!(decoded.format, Format::Ply);
        assert_eq!(decoded.cloud.points, [[1.25, 2.0, 3.0], [-4.0, 0.5, 6.0]]);
        assert_eq!(decoded.cloud.colors, [[255, 0, 10], [1, 2, 3]]);
        assert_eq!(decoded.sensor_position, None);
    }

    #[test]
    fn both_binary_orders_give_the_same_points() {
        let header = |order: &str| {
            format!(
                "ply\nformat binary_{order}_endian 1.0\nelement odd 2\nproperty list uchar short skipped\n\
                element empty 1000000000000000000\nelement vertex 2\nproperty double x\nproperty float y\n\
                property int z\nend_header\n"
            )
        };
        let (mut little, mut big) = (Vec::new(), Vec::new());
        for payload in [&mut little, &mut big] {
            payload.extend_from_slice(&[2, 1, 1, 2, 2, 0]);
        }
        for (x, y, z) in [(1.5f64, -2.0f32, 3i32), (0.1, 0.25, -70000)] {
            little.extend_from_slice(&[&x.to_le_bytes()[..], &y.to_le_bytes(), &z.to_le_bytes()].concat());
            big.extend_from_slice(&[&x.to_be_bytes()[..], &y.to_be_bytes(), &z.to_be_bytes()].concat());
        }
        let little = read(&with_payload(&header("little"), &little)).unwrap();
        let big = read(&with_payload(&header("big"), &big)).unwrap();
        assert_eq!(little, big);
        assert_eq!(little.cloud.points, [[1.5, -2.0, 3.0], [0.1, 0.25, -70000.0]]);
    }

    #[test]
    fn large_coordinates_keep_their_millimetres_beside_stray_zeros() {
        let mut rows = String::from("0 0 0\n");
        for i in 0..100 {
            let _ = writeln!(rows, "{} {} {}", 501_234.0 + f64::from(i) * 0.001, 5_432_100.25, 120.5);
        }
        let header = "ply\nformat ascii 1.0\nelement vertex 101\nproperty double x\nproperty double y\n\
            property double z\nend_header\n";
        let cloud = read(&with_payload(header, rows.as_bytes())).unwrap().cloud;
        assert_eq!(cloud.origin, [501_234.0, 5_432_100.0, 121.0]);
        let millimetre = cloud.points[2][0] - cloud.points[1][0];
        assert!((millimetre - 0.001).abs() < 1e-6, "{millimetre}");
        assert_eq!(cloud.points[1][1], 0.25);
    }

    #[test]
    fn units_scale_the_points_and_broken_ones_are_counted() {
        let file = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n\
            end_header\n1000 2000 3000\nnan 0 0\n0 -inf 0\n0 0 1e30\n";
        let options = DecodeOptions { metres_per_unit: 0.001, ..DecodeOptions::default() };
        let decoded = decode(&mut file.as_bytes(), &options, &CancelToken::new()).unwrap();
        assert_eq!(decoded.cloud.points, [[1.0, 2.0, 3.0]]);
        assert_eq!(decoded.dropped_non_finite, 3);
    }
}
