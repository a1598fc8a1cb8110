//! Parsers of arguments: endpoints, fleets, verifiers, strategies. Invalid ones are wrong usage before anything starts.

use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use decision::Strategy;
use protocol::Keys;
use runtime::wire::check_endpoint;

/// The default fleet.
pub const FLEET_DEFAULT: &str = "local";

/// Parses `HOST:PORT`, or an endpoint in zenoh's syntax: `tcp/HOST:PORT`.
pub fn endpoint(text: &str) -> Result<String, String> {
    let text = text.trim();
    let whole = match text.contains('/') {
        true => text.to_owned(),
        false => format!("tcp/{text}"),
    };
    check_endpoint(&whole)
        .map_err(|_| format!("expected HOST:PORT, such as 192.168.0.7:7447, got {text:?}"))?;
    Ok(whole)
}

/// Parses the name of a fleet.
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

/// Parses the name of a strategy. `--help` lists all strategies with their meanings.
#[derive(Clone)]
pub struct StrategyParser;

impl TypedValueParser for StrategyParser {
    type Value = Strategy;

    fn parse_ref(
        &self,
        command: &clap::Command,
        argument: Option<&clap::Arg>,
        value: &std::ffi::OsStr,
    ) -> Result<Strategy, clap::Error> {
        let names = PossibleValuesParser::new(Strategy::ALL.map(Strategy::name));
        let trimmed = value.to_str().map(|text| text.trim().to_owned());
        let value = trimmed.map_or_else(|| value.to_owned(), Into::into);
        let name = names.parse_ref(command, argument, &value)?;
        let named = Strategy::ALL.into_iter().find(|strategy| strategy.name() == name);
        Ok(named.expect("one of their names"))
    }

    fn possible_values(&self) -> Option<Box<dyn Iterator<Item = PossibleValue> + '_>> {
        let value =
            |strategy: Strategy| PossibleValue::new(strategy.name()).help(strategy.meaning());
        Some(Box::new(Strategy::ALL.into_iter().map(value)))
    }
}

/// The first digits of a digest: enough to tell versions apart by eye.
pub fn short(digest: &str) -> &str {
    digest.get(..12).unwrap_or(digest)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_host_and_a_port_are_enough() {
        assert_eq!(endpoint("10.0.0.7:7447").as_deref(), Ok("tcp/10.0.0.7:7447"));
        assert_eq!(endpoint(" localhost:1 ").as_deref(), Ok("tcp/localhost:1"));
        assert_eq!(endpoint("tcp/[::1]:7447").as_deref(), Ok("tcp/[::1]:7447"));
        for wrong in ["localhost", "tls/a:1", "a:99999", ""] {
            let error = endpoint(wrong).expect_err("no port, or no transport");
            assert!(error.starts_with("expected HOST:PORT"), "{wrong}: {error}");
        }
    }
}
