//! The key that clients send as `Authorization: Api-Key KEY`.

use std::fmt;

use anyhow::{Result, ensure};
use sha2::{Digest, Sha256};
use subtle::ConstantTimeEq;

/// Shorter keys can be guessed.
const KEY_CHARS_MIN: usize = 16;
/// The scheme in the header, as openpi's client sends it.
const SCHEME: &str = "Api-Key ";

/// A secret that every client must know. Only its digest is kept.
#[derive(Clone)]
pub struct ApiKey {
    digest: [u8; 32],
}

impl ApiKey {
    /// A key of at least 16 visible ASCII characters; white space around it is ignored.
    pub fn new(text: &str) -> Result<ApiKey> {
        let text = text.trim();
        let count = text.chars().count();
        ensure!(
            count >= KEY_CHARS_MIN && text.chars().all(|letter| letter.is_ascii_graphic()),
            "key: expected at least {KEY_CHARS_MIN} visible ASCII characters, got {count} characters"
        );
        Ok(ApiKey { digest: Sha256::digest(text).into() })
    }

    /// Whether a header's value holds this key. The time does not depend on how much of it is right.
    pub fn is_in(&self, header: Option<&[u8]>) -> bool {
        let Some(key) = header.and_then(|header| header.strip_prefix(SCHEME.as_bytes())) else {
            return false;
        };
        let digest: [u8; 32] = Sha256::digest(key).into();
        digest.ct_eq(&self.digest).into()
    }
}

impl fmt::Debug for ApiKey {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("ApiKey")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_same_key_under_its_scheme_is_accepted() {
        let key = ApiKey::new(" a-secret-of-sixteen\n").expect("a key");
        assert!(key.is_in(Some(b"Api-Key a-secret-of-sixteen")));
        for header in [
            None,
            Some(&b""[..]),
            Some(b"a-secret-of-sixteen"),
            Some(b"Bearer a-secret-of-sixteen"),
            Some(b"Api-Key a-secret-of-sixtee"),
            Some(b"Api-Key a-secret-of-sixteen "),
        ] {
            assert!(!key.is_in(header), "{header:?}");
        }
        for text in ["", "short", "a secret of sixteen letters"] {
            assert!(ApiKey::new(text).is_err(), "{text}");
        }
    }
}
