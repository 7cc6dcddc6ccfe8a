//! The secret in the address of a page. Without it, the server reveals nothing about the bench.

use std::fmt;
use std::hint::black_box;
use std::io;

/// The minimum length of a token in characters: 16 letters and digits have 95 bits.
const MIN_TOKEN_CHARS: usize = 16;
/// The maximum length of a token in characters, because the token is in the first line of a request.
const MAX_TOKEN_CHARS: usize = 256;

/// A secret that every request has to carry.
#[derive(Clone, Eq, PartialEq)]
pub struct Token(String);

/// The error for a text that cannot be a token. Its message does not contain the text, which may be a secret.
#[derive(Clone, Copy, Debug, Eq, PartialEq, thiserror::Error)]
#[error("a token must consist of 16 to 256 letters or digits")]
pub struct TokenError;

impl Token {
    /// Checks a token that a user has chosen.
    ///
    /// # Errors
    /// Returns [`TokenError`] if the text is too short or too long, or has other characters than letters and digits.
    pub fn parse(text: &str) -> Result<Self, TokenError> {
        let is_plain = text.bytes().all(|byte| byte.is_ascii_alphanumeric());
        let fits = (MIN_TOKEN_CHARS..=MAX_TOKEN_CHARS).contains(&text.len());
        if fits && is_plain { Ok(Self(text.to_owned())) } else { Err(TokenError) }
    }

    /// Generates a random token of 128 bits.
    ///
    /// # Errors
    /// Returns an error if the kernel cannot provide random bytes.
    pub fn random() -> io::Result<Self> {
        let mut bytes = [0; 16];
        getrandom::fill(&mut bytes).map_err(io::Error::other)?;
        Ok(Self(format!("{:032x}", u128::from_ne_bytes(bytes))))
    }

    /// Returns the token as text.
    #[must_use]
    pub fn as_str(&self) -> &str {
        &self.0
    }

    /// Returns true if a given text is the token. The time for this does not depend on where the two differ.
    #[must_use]
    pub fn matches(&self, given: &str) -> bool {
        let pairs = given.bytes().zip(self.0.bytes());
        let differences = pairs.fold(0, |differences, (one, other)| black_box(differences | (one ^ other)));
        given.len() == self.0.len() && differences == 0
    }
}

impl fmt::Debug for Token {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("Token(..)")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_token_is_long_plain_and_not_printed_by_accident() {
        let token = Token::parse("abcdef0123456789").unwrap();
        assert!(token.matches("abcdef0123456789"));
        for wrong in ["", "abcdef012345678", "abcdef0123456788", "abcdef01234567890", "ABCDEF0123456789"] {
            assert!(!token.matches(wrong), "{wrong}");
        }
        assert_eq!(format!("{token:?}"), "Token(..)");
        for wrong in ["", "short", "abcdef 0123456789", "abcdef0123456789\n", &"a".repeat(257)] {
            assert_eq!(Token::parse(wrong), Err(TokenError), "{wrong:?}");
        }
    }

    #[test]
    fn random_tokens_differ_and_may_be_given() {
        let [one, other] = [(), ()].map(|()| Token::random().unwrap());
        assert_ne!(one, other);
        assert_eq!((one.as_str().len(), Token::parse(one.as_str())), (32, Ok(one.clone())));
    }
}
