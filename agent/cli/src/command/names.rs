//! Endpoints and names on the network, as arguments: what cannot be used is wrong usage, not a failure after a wait.

use protocol::Keys;
use runtime::wire::check_endpoint;

/// The fleet of those that name none.
pub const FLEET_DEFAULT: &str = "local";

/// Parses `tcp/HOST:PORT`.
pub fn endpoint(text: &str) -> Result<String, String> {
    check_endpoint(text).map_err(|error| error.to_string())?;
    Ok(text.to_owned())
}

/// Parses a fleet's name.
pub fn fleet(text: &str) -> Result<String, String> {
    Keys::new(text).map_err(|error| error.to_string())?;
    Ok(text.to_owned())
}

/// Parses the name of a published verifier.
pub fn verifier(text: &str) -> Result<String, String> {
    let keys = Keys::new(FLEET_DEFAULT).and_then(|keys| keys.verifier(text));
    keys.map_err(|error| error.to_string())?;
    Ok(text.to_owned())
}
