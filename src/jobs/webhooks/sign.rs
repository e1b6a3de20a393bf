//! Signatures as Standard Webhooks has them (<https://www.standardwebhooks.com>), so that receivers find a library.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use hmac::{Hmac, KeyInit, Mac};
use sha2::Sha256;

use crate::project::SigningSecret;

/// A new secret. Fails if the system gives no random bytes.
pub fn new_secret() -> Result<SigningSecret, getrandom::Error> {
    let mut bytes = [0; 32];
    getrandom::fill(&mut bytes)?;
    Ok(SigningSecret(bytes))
}

/// The text of a secret that a receiver configures.
#[must_use]
pub fn reveal(secret: &SigningSecret) -> String {
    format!("whsec_{}", STANDARD.encode(secret.0))
}

/// The value of the header `webhook-signature`: HMAC-SHA256 over id, seconds since 1970 and body, joined by points. The
/// receiver refuses what is too old, so that nobody can send it again.
#[must_use]
pub fn signature(secret: &SigningSecret, id: &str, seconds: i64, body: &str) -> String {
    // HMAC fills a short key up with zeros to the block of its hash; a whole block cannot be of the wrong length.
    let mut block = [0; 64];
    block[..32].copy_from_slice(&secret.0);
    let mut mac = Hmac::<Sha256>::new(&block.into());
    mac.update(format!("{id}.{seconds}.{body}").as_bytes());
    format!("v1,{}", STANDARD.encode(mac.finalize().into_bytes()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn signatures_are_those_of_the_standard() {
        // The reference is that of `openssl`'s:
        // printf 'msg_1.1700000000.{}' | openssl dgst -sha256 -mac HMAC -macopt hexkey:0707…07 -binary | base64
        let secret = SigningSecret([7; 32]);
        assert_eq!(
            signature(&secret, "msg_1", 1_700_000_000, "{}"),
            "v1,nuLLyheCKcS2N8JNOFt5stk98R+umYWr26/ZTfdtGM8="
        );
        assert_ne!(
            signature(&secret, "msg_1", 1_700_000_001, "{}"),
            "v1,nuLLyheCKcS2N8JNOFt5stk98R+umYWr26/ZTfdtGM8="
        );
        assert!(reveal(&secret).starts_with("whsec_BwcHBwcH"));
    }
}
