//! The parsers, and what each promises for any bytes at all.

use std::io::{BufReader, Read};

use cairn::cloud::{DecodeOptions, Decoded, ScanKey, decode};
use cairn::control::{CancelToken, Control, Seed, Silent};
use cairn::features::{
    PrepareOptions, PreparedScan, Scan, SensorPosition, choose_resolution, natural_resolution, prepare,
};
use cairn::geometry::pose_text;
use cairn::http::{parse_checksum, parse_content_digest, parse_metadata};
use cairn::mapping::{LiveModel, MappingOptions, ModelSnapshot};
use cairn::project::motion;

pub const PLY: [&str; 24] = [
    "ply\n",
    "format ascii 1.0\n",
    "format binary_little_endian 1.0\n",
    "format binary_big_endian 1.0\n",
    "comment ",
    "obj_info ",
    "element vertex 3\n",
    "element face 2\n",
    "property float x\n",
    "property double y\n",
    "property uchar red\n",
    "property list uchar int vertex_indices\n",
    "property list double uint q\n",
    "end_header\n",
    "float32",
    "int8",
    "uint16",
    "list",
    "char",
    "uchar",
    "short",
    "double",
    "vertex",
    "red",
];
pub const PCD: [&str; 22] = [
    "# .PCD v0.7\n",
    "VERSION 0.7\n",
    "FIELDS x y z rgb\n",
    "COLUMNS x y z\n",
    "SIZE 4 4 4 4\n",
    "SIZE 8 8 8 1\n",
    "TYPE F F F U\n",
    "TYPE I I I F\n",
    "COUNT 1 1 1 3\n",
    "WIDTH 2\n",
    "HEIGHT 1\n",
    "VIEWPOINT 1 2 3 1 0 0 0\n",
    "POINTS 2\n",
    "DATA ascii\n",
    "DATA binary\n",
    "DATA binary_compressed\n",
    "rgba",
    "normal_x",
    "_",
    "F",
    "U",
    "I",
];
pub const TEXT: [&str; 16] = [
    "x y z\n",
    "X;Y;Z;R;G;B\n",
    "// ",
    "# ",
    "intensity",
    "red",
    "\u{feff}",
    "1 2 3\n",
    "1,5;2,5;3,5\n",
    "1,2,3\n",
    "2\n",
    "nan nan nan\n",
    "255 255 255\n",
    "\r\n",
    "1e5",
    "-.5",
];
pub const POSES: [&str; 8] = [
    "0 0 0 0 0 0 1\n",
    "1 0 0 0 0 1 0 0 0 0 1 0\n",
    "0 1 2\n",
    "1 0 0 0\n",
    "0 0 0 1\n",
    "# ",
    "1e-9",
    "1 0 0 0 0 0\n",
];
pub const JSON: [&str; 12] = [
    "[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]",
    "[",
    "]",
    "{",
    "}",
    "null",
    "true",
    "\"",
    ",",
    "1e400",
    "-0.0",
    "\\u0000",
];
pub const HEADERS: [&str; 17] = [
    "project MDFBUlozTkRFS1RTVjRSUkZGUTY5RzVGQVY=",
    "name YS5wbHk=",
    "filename YS54eXo=",
    "units bW0=",
    "sensor_position MSwyLDM=",
    "up MCwwLDE=",
    "filetype bW9kZWwvcGx5",
    "sha1 ",
    "sha256 ",
    "sha512 ",
    "sha-256=:",
    "sha-512=:",
    ":",
    "=",
    ",",
    "Kq5sNclPz7QV2+lfQIuc6R7oRu0=",
    "47DEQpj8HBSa+/TImW+5JCeuQeRkm5NMpJWZG3hSuFU=",
];

/// Gives its bytes in pieces of odd sizes, as a network does.
struct Dribble<'a>(&'a [u8], usize);

impl Read for Dribble<'_> {
    fn read(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
        self.1 = self.1 % 5 + 1;
        let n = self.1.min(self.0.len()).min(buffer.len());
        let (now, later) = self.0.split_at(n);
        buffer[..n].copy_from_slice(now);
        self.0 = later;
        Ok(n)
    }
}

/// Decodes at most 100,000 points.
fn decoded(reader: &mut dyn std::io::BufRead) -> Result<Decoded, String> {
    let options = DecodeOptions { max_points: 100_000, ..DecodeOptions::default() };
    decode(reader, &options, &CancelToken::new()).map_err(|error| error.to_string())
}

/// A file of points: what is decoded is finite and not more than the bytes can hold, and does not depend on how they come.
pub fn scan(mut input: &[u8]) -> String {
    let bytes = input.len();
    let mut pieces = BufReader::with_capacity(7, Dribble(input, 0));
    let whole = decoded(&mut input);
    assert_eq!(whole, decoded(&mut pieces), "how the bytes come makes a difference");
    match whole {
        Ok(Decoded { cloud, format, sensor_position, dropped_non_finite }) => {
            assert!(!cloud.is_empty());
            // LZF unfolds at most 88 times.
            assert!((cloud.len() as u64 + dropped_non_finite) <= bytes as u64 * 88);
            assert!(cloud.points.iter().flatten().all(|x| x.is_finite()));
            assert!(cloud.origin.iter().all(|x| x.is_finite()));
            assert!(cloud.colors.is_empty() || cloud.colors.len() == cloud.len());
            let seen = (cloud.colors.is_empty(), sensor_position.is_some(), dropped_non_finite > 0);
            format!("{format} {} points {seen:?}", "|".repeat(cloud.len().ilog2() as usize))
        }
        Err(error) => error,
    }
}

/// A file of points that is decoded and prepared as a job does it: whatever the points are, that ends, with finite numbers.
pub fn prepared(mut input: &[u8]) -> String {
    let Ok(file) = decoded(&mut input) else { return "no scan".to_owned() };
    let natural = natural_resolution(&file.cloud.points);
    let options = PrepareOptions::at(choose_resolution(&[natural]), Seed(0));
    let (token, key) = (CancelToken::new(), ScanKey::of_hash(&blake3::hash(b"scan"), &[]));
    let control = Control { cancel: &token, observer: &Silent };
    let position = file.sensor_position.map_or(SensorPosition::Assumed, SensorPosition::Known);
    match prepare(key, &file.cloud, position, &options, control) {
        Ok(scan) => {
            assert!(scan.points.iter().flatten().all(|x| x.is_finite()));
            assert!(scan.normals.iter().flatten().all(|x| x.is_finite()));
            assert!(scan.colors.is_empty() || scan.colors.len() == scan.points.len());
            assert!(scan.descriptors.iter().all(|x| x.is_finite()));
            let scan = Scan::new(scan);
            if let Some(finer) = scan.fine() {
                assert!(finer.prepared.points.iter().flatten().all(|x| x.is_finite()));
                assert!(finer.prepared.normals.iter().flatten().all(|x| x.is_finite()));
            }
            let planes = scan.planes().is_some();
            format!("prepared, planes {planes}")
        }
        Err(error) => error.to_string(),
    }
}

/// Poses as text: what is read is a rigid motion, and survives being written and read.
pub fn poses(input: &[u8]) -> String {
    let text = String::from_utf8_lossy(input);
    let tum = pose_text::parse_tum(&text).map(|poses| {
        assert!(poses.iter().all(|(_, pose)| pose.to_rows().iter().flatten().all(|x| x.is_finite())));
        poses.len()
    });
    let kitti = pose_text::parse_kitti(&text).map(|poses| {
        let again = pose_text::parse_kitti(&pose_text::to_kitti(poses.iter().copied()));
        assert_eq!(again.map(|poses| poses.len()), Ok(poses.len()));
        poses.len()
    });
    let log = pose_text::parse_log(&text).map(|entries| {
        let again = pose_text::parse_log(&pose_text::to_log(&entries));
        assert_eq!(again.map(|entries| entries.len()), Ok(entries.len()));
        entries.len()
    });
    let info = pose_text::parse_info(&text).map(|entries| entries.len());
    format!("{tum:?} {kitti:?} {log:?} {info:?}")
}

/// The pose of a decision: what is read is rigid, and reading it again gives the same.
pub fn motion_of_decision(input: &[u8]) -> String {
    let value: serde_json::Value = match serde_json::from_slice(input) {
        Ok(value) => value,
        Err(error) => return error.to_string(),
    };
    match motion(&value) {
        Ok(pose) => {
            let rows = serde_json::to_value(pose.to_rows()).unwrap();
            let again = motion(&rows).expect("what was read can be read again");
            assert!((again.inverse() * pose).translation.norm() < 1e-3);
            "a motion".to_owned()
        }
        Err(error) => error.to_string(),
    }
}

/// Headers of uploads: refusals are 400, and name what is wrong.
pub fn headers(input: &[u8]) -> String {
    let text = String::from_utf8_lossy(input);
    let refused = |problem: cairn::http::Problem| {
        assert_eq!(problem.status, 400);
        assert!(problem.field.is_some());
        // Who sends kilobytes does not get kilobytes back.
        assert!(problem.detail.len() < 1000, "{}", problem.detail);
        problem.detail
    };
    let metadata = parse_metadata(&text).map_or_else(refused, |metadata| {
        metadata.interpretation.validate().expect("what is accepted makes sense");
        "metadata".to_owned()
    });
    let whole = |digest: &cairn::jobs::ExpectedDigest| digest.value.len() == digest.algorithm.bytes();
    let checksum = parse_checksum(&text).map_or_else(refused, |digest| {
        assert!(whole(&digest));
        "checksum".to_owned()
    });
    let digests = parse_content_digest(&text).map_or_else(refused, |digests| {
        assert!(!digests.is_empty() && digests.iter().all(whole));
        "digests".to_owned()
    });
    format!("{metadata} {checksum} {digests}")
}

/// A model's snapshot: what is read can be written, and one whose scans are missing is refused.
pub fn snapshot(input: &[u8]) -> String {
    match ModelSnapshot::from_bytes(input) {
        Ok(snapshot) => {
            // Numbers that are none do not equal themselves, so bytes are compared.
            let bytes = snapshot.to_bytes().expect("what was read can be written");
            let again = ModelSnapshot::from_bytes(&bytes).expect("what was written can be read");
            assert_eq!(again.to_bytes(), Ok(bytes));
            let restored = LiveModel::restore(MappingOptions::default(), &snapshot, Vec::new(), Vec::new());
            assert_eq!(restored.is_ok(), snapshot.scans.is_empty());
            format!("{} components, {:?}", "|".repeat(snapshot.components.len().min(9)), restored.is_ok())
        }
        Err(error) => error.to_string(),
    }
}

/// A prepared scan: what is read can be written.
pub fn prepared_scan(input: &[u8]) -> String {
    match PreparedScan::from_bytes(input) {
        Ok(scan) => {
            let bytes = scan.to_bytes().expect("what was read can be written");
            let again = PreparedScan::from_bytes(&bytes).expect("what was written can be read");
            assert_eq!(again.to_bytes(), Ok(bytes));
            format!("read, {} range image", scan.range_image.is_some())
        }
        Err(error) => error.to_string(),
    }
}
