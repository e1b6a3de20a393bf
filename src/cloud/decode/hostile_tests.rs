//! Files that lie, break off or are something else: each is its own error, and none costs memory or panics.

use proptest::prelude::*;

use super::{DecodeError, DecodeOptions, Decoded, decode};
use crate::control::CancelToken;

fn read(bytes: &[u8]) -> Result<Decoded, DecodeError> {
    decode(&mut &*bytes, &DecodeOptions::default(), &CancelToken::new())
}

fn ply(format: &str, count: &str, payload: &[u8]) -> Vec<u8> {
    let header = format!(
        "ply\nformat {format} 1.0\nelement vertex {count}\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    );
    [header.as_bytes(), payload].concat()
}

fn floats(values: &[f32]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}

const BINARY: &str = "binary_little_endian";

#[test]
fn an_empty_file_is_empty() {
    assert!(matches!(read(b""), Err(DecodeError::Empty)));
    assert!(matches!(read(&ply(BINARY, "0", b"")), Err(DecodeError::NoPoints)));
}

#[test]
fn a_truncated_file_says_how_many_points_are_there() {
    let mut payload = floats(&[1.0; 300]);
    payload.truncate(1195);
    let error = read(&ply(BINARY, "100", &payload)).unwrap_err();
    assert!(matches!(error, DecodeError::Truncated { declared: 100, present: 99, .. }), "{error}");
    assert_eq!(error.to_string(), "the file is truncated: 99 of 100 points are present");
    let error = read(&ply("ascii", "3", b"1 2 3\n4 5 6\n7 8")).unwrap_err();
    assert!(matches!(error, DecodeError::Truncated { declared: 3, present: 2, .. }), "{error}");
}

#[test]
fn a_header_that_declares_too_few_points_is_a_lie() {
    let error = read(&ply(BINARY, "2", &floats(&[1.0; 9]))).unwrap_err();
    assert!(matches!(error, DecodeError::ExcessData { declared: 2, .. }), "{error}");
    let padded = [floats(&[1.0; 6]), vec![0; 64]].concat();
    assert_eq!(read(&ply(BINARY, "2", &padded)).unwrap().cloud.len(), 2, "zeros are padding");
}

#[test]
fn a_huge_count_costs_nothing() {
    let error = read(&ply(BINARY, "1000000000000000000", &floats(&[1.0; 9]))).unwrap_err();
    assert!(
        matches!(error, DecodeError::TooManyPoints { points: 1_000_000_000_000_000_000, limit: 200_000_000 }),
        "{error}"
    );
    let error = read(&ply(BINARY, "200000000", &floats(&[1.0; 9]))).unwrap_err();
    assert!(matches!(error, DecodeError::Truncated { declared: 200_000_000, present: 3, .. }), "{error}");
}

#[test]
fn text_where_binary_is_declared_and_binary_where_text_is() {
    let text = b"0.1 0.2 0.3\n1.1 1.2 1.3\n2.1 2.2 2.3\n";
    assert!(matches!(read(&ply(BINARY, "3", text)), Err(DecodeError::TextForBinary { .. })));
    let error = read(&ply("ascii", "3", &floats(&[1.0; 9]))).unwrap_err();
    assert!(matches!(error, DecodeError::NotText { line: 8, .. }), "{error}");
}

#[test]
fn a_file_of_another_kind_is_named() {
    let error = read(b"\x89PNG\r\n\x1a\n0000").unwrap_err();
    assert!(matches!(error, DecodeError::UnknownFormat { looks_like: Some("a PNG picture") }), "{error}");
    assert!(matches!(read(b"lorem ipsum\n"), Err(DecodeError::UnknownFormat { looks_like: None })));
}

#[test]
fn only_points_that_are_not_finite_are_no_points() {
    let error = read(&ply(BINARY, "3", &floats(&[f32::NAN; 9]))).unwrap_err();
    assert!(matches!(error, DecodeError::OnlyNonFinite { dropped: 3 }), "{error}");
}

#[test]
fn a_line_without_end_is_refused_at_the_limit() {
    let mut file = b"1 2 3\n".to_vec();
    file.resize(1 << 20, b'1');
    assert!(matches!(read(&file), Err(DecodeError::LineTooLong { line: 2, .. })));
    let header = [&b"ply\ncomment "[..], &vec![b'x'; 1 << 20]].concat();
    assert!(matches!(read(&header), Err(DecodeError::LineTooLong { line: 2, .. })));
}

#[test]
fn cancellation_stops_the_reading() {
    let cancel = CancelToken::new();
    cancel.cancel();
    let file = ply(BINARY, "3", &floats(&[1.0; 9]));
    let result = decode(&mut file.as_slice(), &DecodeOptions::default(), &cancel);
    assert!(matches!(result, Err(DecodeError::Cancelled(_))));
}

/// Good files of every kind, to be damaged.
fn seeds() -> Vec<Vec<u8>> {
    let lists = "ply\nformat binary_big_endian 1.0\nelement face 2\nproperty list uchar int i\nelement vertex 2\n\
        property list char short l\nproperty double x\nproperty float y\nproperty uchar z\nproperty uchar red\n\
        property uchar green\nproperty uchar blue\nend_header\n";
    let pcd = |data: &str| {
        format!(
            "VERSION 0.7\nFIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F U\nCOUNT 1 1 1 1\nWIDTH 2\nHEIGHT 1\n\
             VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 2\nDATA {data}\n"
        )
        .into_bytes()
    };
    vec![
        ply(BINARY, "3", &floats(&[1.0; 9])),
        ply("ascii", "2", b"1 2 3\n4 5 6\n"),
        [lists.as_bytes(), &[0; 64]].concat(),
        [pcd("ascii"), b"1 2 3 4\n5 6 7 8\n".to_vec()].concat(),
        [pcd("binary"), floats(&[1.0; 8])].concat(),
        [pcd("binary_compressed"), vec![6, 0, 0, 0, 32, 0, 0, 0, 0, 7, 0xe0, 22, 0, 0]].concat(),
        b"2\n1 2 3 4 5 6 7\n1 2 3 4 5 6 7\n".to_vec(),
        b"x;y;z\n1,5;2;3\n4;5;6\n".to_vec(),
    ]
}

fn damaged() -> impl Strategy<Value = Vec<u8>> {
    let edit = (any::<prop::sample::Index>(), any::<u8>(), 0..4u8);
    (prop::sample::select(seeds()), prop::collection::vec(edit, 1..6)).prop_map(|(mut file, edits)| {
        for (index, byte, kind) in edits {
            if file.is_empty() {
                break;
            }
            let at = index.index(file.len());
            match kind {
                0 => file[at] = byte,
                1 => file.insert(at, b'0' + byte % 10),
                2 => drop(file.remove(at)),
                _ => file.truncate(at),
            }
        }
        file
    })
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 2000, ..ProptestConfig::default() })]

    #[test]
    fn damaged_files_never_panic_and_never_give_more_points_than_bytes(file in damaged()) {
        if let Ok(decoded) = read(&file) {
            prop_assert!(!decoded.cloud.is_empty());
            // LZF unfolds at most 88 times.
            prop_assert!(decoded.cloud.len() <= file.len() * 88 && decoded.cloud.points.capacity() <= 65_536);
            prop_assert!(decoded.cloud.points.iter().flatten().all(|x| x.is_finite()));
            prop_assert!(decoded.cloud.colors.is_empty() || decoded.cloud.colors.len() == decoded.cloud.len());
        }
    }

    #[test]
    fn arbitrary_bytes_never_panic(
        mark in prop::sample::select(vec!["", "ply\n", "VERSION 0.7\n", "1 2 3\n", "3\n"]),
        tail in prop::collection::vec(any::<u8>(), 0..400),
    ) {
        let _ = read(&[mark.as_bytes(), &tail].concat());
    }
}
