//! Token of a page: from a file, from the environment, or random.

use std::fs::File;
use std::io::{self, Read};
use std::net::SocketAddr;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

use protocol::usage::Failure;
use view::Token;

use crate::output::print_note;

/// Environment variable that holds the token. A run passes the token to its page in it, because only the same user can
/// read it there.
pub(super) const TOKEN_VARIABLE: &str = "SKINBUS_TOKEN";
/// Maximum number of bytes read from a token file.
const MAX_FILE_BYTES: u64 = 4096;

/// Returns the token that the user has chosen: from a file, or else from the environment.
pub(super) fn chosen_token(file: Option<&Path>) -> Result<Option<Token>, Failure> {
    match file {
        Some(path) => read(path).map(Some),
        None => token_from_environment(),
    }
}

/// Returns the token that a page must have. A page that can act, or that other machines can reach, always has one.
pub(super) fn required_token(
    chosen: Option<Token>,
    acts: bool,
    listen: SocketAddr,
) -> Result<Option<Token>, Failure> {
    match chosen {
        Some(token) => Ok(Some(token)),
        None if acts || !listen.ip().is_loopback() => {
            let failed = |error| {
                Failure::run_error(format!(
                    "cannot create a random token for the page: {error}; give one with --token-file"
                ))
            };
            Token::random().map(Some).map_err(failed)
        }
        None => Ok(None),
    }
}

fn token_from_environment() -> Result<Option<Token>, Failure> {
    let Some(text) = std::env::var_os(TOKEN_VARIABLE).filter(|text| !text.is_empty()) else {
        return Ok(None);
    };
    let token = Token::parse(&text.to_string_lossy());
    token.map(Some).map_err(|error| Failure::usage_error(format!("{TOKEN_VARIABLE}: {error}")))
}

fn read(path: &Path) -> Result<Token, Failure> {
    let name = path.display();
    let text = || -> io::Result<(String, File)> {
        let file = File::open(path)?;
        let mut text = String::new();
        (&file).take(MAX_FILE_BYTES).read_to_string(&mut text)?;
        Ok((text, file))
    };
    let (text, file) =
        text().map_err(|error| Failure::usage_error(format!("--token-file {name}: {error}")))?;
    let token = Token::parse(text.trim());
    let token = token.map_err(|error| Failure::usage_error(format!("--token-file {name}: {error}")))?;
    let others =
        file.metadata().ok().filter(|about| about.is_file() && about.permissions().mode() & 0o077 != 0);
    if others.is_some() {
        print_note(format_args!("--token-file {name}: other users may read it; protect it with `chmod 600`"));
    }
    Ok(token)
}
