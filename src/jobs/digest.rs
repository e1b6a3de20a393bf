//! Digests that a client announces for the bytes that it sends, checked while they come.

use sha1::Sha1;
use sha2::{Digest as _, Sha256, Sha512};

/// A hash function that clients may use.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DigestAlgorithm {
    /// SHA-1: detects accidents, not attackers. tus asks every server to know it.
    Sha1,
    /// SHA-256.
    Sha256,
    /// SHA-512.
    Sha512,
}

impl DigestAlgorithm {
    /// Length of its result, bytes.
    #[must_use]
    pub fn bytes(self) -> usize {
        match self {
            Self::Sha1 => 20,
            Self::Sha256 => 32,
            Self::Sha512 => 64,
        }
    }
}

impl std::fmt::Display for DigestAlgorithm {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.pad(match self {
            Self::Sha1 => "SHA-1",
            Self::Sha256 => "SHA-256",
            Self::Sha512 => "SHA-512",
        })
    }
}

/// What the bytes of one request shall hash to.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ExpectedDigest {
    /// The function.
    pub algorithm: DigestAlgorithm,
    /// Its result.
    pub value: Vec<u8>,
}

/// The bytes that came are not those that were sent.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "the {algorithm} of the bytes that came is {found}, but {expected} was announced; nothing of them is kept"
)]
pub struct DigestMismatch {
    /// The function.
    pub algorithm: DigestAlgorithm,
    /// What was announced, hexadecimal.
    pub expected: String,
    /// What came, hexadecimal.
    pub found: String,
}

/// Hashes that are being computed.
#[derive(Debug)]
pub(super) struct DigestCheck {
    running: Vec<(ExpectedDigest, Hasher)>,
}

#[derive(Debug)]
enum Hasher {
    Sha1(Sha1),
    Sha256(Sha256),
    Sha512(Sha512),
}

impl DigestCheck {
    pub fn new(expected: Vec<ExpectedDigest>) -> Self {
        let hasher = |digest: &ExpectedDigest| match digest.algorithm {
            DigestAlgorithm::Sha1 => Hasher::Sha1(Sha1::new()),
            DigestAlgorithm::Sha256 => Hasher::Sha256(Sha256::new()),
            DigestAlgorithm::Sha512 => Hasher::Sha512(Sha512::new()),
        };
        Self { running: expected.into_iter().map(|d| (hasher(&d), d)).map(|(h, d)| (d, h)).collect() }
    }

    /// Whether there is nothing to check.
    pub fn is_empty(&self) -> bool {
        self.running.is_empty()
    }

    pub fn update(&mut self, piece: &[u8]) {
        for (_, hasher) in &mut self.running {
            match hasher {
                Hasher::Sha1(h) => h.update(piece),
                Hasher::Sha256(h) => h.update(piece),
                Hasher::Sha512(h) => h.update(piece),
            }
        }
    }

    /// Whether all digests are as announced.
    pub fn finish(self) -> Result<(), DigestMismatch> {
        for (expected, hasher) in self.running {
            let found = match hasher {
                Hasher::Sha1(h) => h.finalize().to_vec(),
                Hasher::Sha256(h) => h.finalize().to_vec(),
                Hasher::Sha512(h) => h.finalize().to_vec(),
            };
            if found != expected.value {
                let (expected, found, algorithm) = (hex(&expected.value), hex(&found), expected.algorithm);
                return Err(DigestMismatch { algorithm, expected, found });
            }
        }
        Ok(())
    }
}

fn hex(bytes: &[u8]) -> String {
    use std::fmt::Write as _;
    bytes.iter().fold(String::new(), |mut text, byte| {
        // Writing to a string cannot fail.
        let _ = write!(text, "{byte:02x}");
        text
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn known_digests_of_abc_agree_and_others_do_not() {
        let sha1 =
            b"\xa9\x99\x3e\x36\x47\x06\x81\x6a\xba\x3e\x25\x71\x78\x50\xc2\x6c\x9c\xd0\xd8\x9d".to_vec();
        let expected =
            |value: &[u8]| vec![ExpectedDigest { algorithm: DigestAlgorithm::Sha1, value: value.to_vec() }];
        let check = |value: &[u8]| {
            let mut check = DigestCheck::new(expected(value));
            check.update(b"a");
            check.update(b"bc");
            check.finish()
        };
        assert_eq!(check(&sha1), Ok(()));
        let mismatch = check(&[0; 20]).unwrap_err();
        assert!(mismatch.to_string().contains("a9993e364706816aba3e25717850c26c9cd0d89d"), "{mismatch}");
    }
}
