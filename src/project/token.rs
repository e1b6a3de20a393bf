//! What the holder of a key shows: `cairn_`, the key's id, `_`, and 32 random bytes in hexadecimal.
//!
//! The secret is as random as its hash, so one fast hash keeps it: there is nothing to guess by dictionary.

use std::fmt;
use std::str::FromStr;

use blake3::Hash;

use super::{BadId, KeyId};

/// The whole text that opens the service. Its `Debug` says which key it is, and nothing of the secret.
#[derive(Clone)]
pub struct Token {
    /// Which key it claims to be.
    pub key: KeyId,
    secret: Hash,
}

/// What is kept of a secret. Comparing two takes the same time whatever they are.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Digest(Hash);

/// Why a token cannot be made or read. Says nothing of its text.
#[derive(Debug, thiserror::Error)]
pub enum BadToken {
    /// The system gives no random bytes.
    #[error("the system gives no random bytes: {0}")]
    NoRandomness(getrandom::Error),
    /// The text is no token.
    #[error("the text is no key: it should be `cairn_`, 26 characters of base 32, `_`, 64 of base 16")]
    Malformed,
}

const PREFIX: &str = "cairn_";
/// Sets this use of the hash apart from every other one.
const CONTEXT: &str = "cairn 2026-11-22 digest of an api key's secret";

impl Token {
    /// A new secret for a key.
    pub fn generate(key: KeyId) -> Result<Self, BadToken> {
        let mut secret = [0; 32];
        getrandom::fill(&mut secret).map_err(BadToken::NoRandomness)?;
        Ok(Self { key, secret: Hash::from_bytes(secret) })
    }

    /// The text to hand out, once.
    #[must_use]
    pub fn reveal(&self) -> String {
        format!("{PREFIX}{}_{}", self.key, self.secret.to_hex())
    }

    /// What to keep of it.
    #[must_use]
    pub fn digest(&self) -> Digest {
        Digest(Hash::from_bytes(blake3::derive_key(CONTEXT, self.secret.as_bytes())))
    }
}

impl Digest {
    /// From its bytes, as they were stored.
    #[must_use]
    pub fn from_bytes(bytes: [u8; 32]) -> Self {
        Self(Hash::from_bytes(bytes))
    }

    /// The bytes to store.
    #[must_use]
    pub fn as_bytes(&self) -> &[u8; 32] {
        self.0.as_bytes()
    }
}

impl FromStr for Token {
    type Err = BadToken;

    fn from_str(text: &str) -> Result<Self, BadToken> {
        let (key, secret) =
            text.strip_prefix(PREFIX).and_then(|rest| rest.split_once('_')).ok_or(BadToken::Malformed)?;
        let key = key.parse().map_err(|_: BadId| BadToken::Malformed)?;
        let secret = Hash::from_hex(secret).map_err(|_| BadToken::Malformed)?;
        Ok(Self { key, secret })
    }
}

impl fmt::Debug for Token {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Token({})", self.key)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_token_survives_its_text_and_every_other_secret_has_another_digest() {
        let key = KeyId::generate();
        let (token, other) = (Token::generate(key).unwrap(), Token::generate(key).unwrap());
        let read: Token = token.reveal().parse().unwrap();
        assert_eq!((read.key, read.digest()), (key, token.digest()));
        assert_ne!(token.digest(), other.digest());
        assert_eq!(Digest::from_bytes(*token.digest().as_bytes()), token.digest());
    }

    #[test]
    fn neither_the_digest_nor_what_debugging_prints_holds_the_secret() {
        let token = Token::generate(KeyId::generate()).unwrap();
        let text = token.reveal();
        let secret = text.rsplit_once('_').unwrap().1;
        assert!(!format!("{token:?} {:?}", token.digest()).contains(secret));
    }

    #[test]
    fn other_text_is_refused_without_repeating_it() {
        let good = Token::generate(KeyId::generate()).unwrap().reveal();
        for text in ["", "cairn_", "cairn__", &good[1..], &good[..good.len() - 1], "cairn_ü_ü", "Bearer x"]
        {
            let error = text.parse::<Token>().unwrap_err().to_string();
            assert!(text.len() < 8 || !error.contains(text), "{error}");
        }
    }
}
