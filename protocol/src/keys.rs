//! The zenoh keys under `rever/3/{fleet}/`, built from validated names.

use crate::PROTOCOL_VERSION;

/// Maximum length of a name in a key.
pub const KEY_NAME_BYTES_MAX: usize = 64;

/// A name that is not valid in a key.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("invalid {what} name {name:?}: expected 1 to 64 characters from a-z A-Z 0-9 . _ -")]
pub struct KeyError {
    /// What the name is of, such as `fleet`.
    pub what: &'static str,
    /// The invalid name.
    pub name: String,
}

/// All keys of one fleet. A fleet is a namespace: agents and servers see each other only within the
/// same fleet.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Keys {
    prefix: String,
}

impl Keys {
    /// The keys of `fleet`.
    pub fn new(fleet: &str) -> Result<Self, KeyError> {
        let fleet = checked("fleet", fleet)?;
        Ok(Self { prefix: format!("rever/{PROTOCOL_VERSION}/{fleet}") })
    }

    /// Liveliness token of a server: the server exists.
    pub fn server(&self, server: &str) -> Result<String, KeyError> {
        Ok(format!("{}/server/{}", self.prefix, checked("server", server)?))
    }

    /// Queryable of a server: no payload, answered with a `Description`.
    pub fn describe(&self, server: &str) -> Result<String, KeyError> {
        Ok(format!("{}/describe", self.server(server)?))
    }

    /// Queryable of a server: `Open`, answered with an `Opening`.
    pub fn open(&self, server: &str) -> Result<String, KeyError> {
        Ok(format!("{}/open", self.server(server)?))
    }

    /// A server's `Heartbeat`.
    pub fn heartbeat(&self, server: &str) -> Result<String, KeyError> {
        Ok(format!("{}/heartbeat", self.server(server)?))
    }

    /// Liveliness token of an agent: the holder of this session is alive.
    pub fn session(&self, session: &str) -> Result<String, KeyError> {
        Ok(format!("{}/session/{}", self.prefix, checked("session", session)?))
    }

    /// A holder's `Request`.
    pub fn request(&self, session: &str) -> Result<String, KeyError> {
        Ok(format!("{}/request", self.session(session)?))
    }

    /// A server's `Reply`.
    pub fn reply(&self, session: &str) -> Result<String, KeyError> {
        Ok(format!("{}/reply", self.session(session)?))
    }

    /// `EpisodeOutcome` of a run.
    pub fn outcome(&self, run: &str) -> Result<String, KeyError> {
        Ok(format!("{}/outcome/{}", self.prefix, checked("run", run)?))
    }

    /// `VerifierUpdate` of a verifier.
    pub fn verifier(&self, name: &str) -> Result<String, KeyError> {
        Ok(format!("{}/verifier/{}", self.prefix, checked("verifier", name)?))
    }

    /// Matches the token of every server.
    pub fn servers(&self) -> String {
        format!("{}/server/*", self.prefix)
    }

    /// Matches the heartbeat of every server.
    pub fn heartbeats(&self) -> String {
        format!("{}/server/*/heartbeat", self.prefix)
    }

    /// Matches the outcomes of every run.
    pub fn outcomes(&self) -> String {
        format!("{}/outcome/*", self.prefix)
    }

    /// The server in the key of a server's token or heartbeat, `None` for any other key.
    pub fn server_of<'a>(&self, key: &'a str) -> Option<&'a str> {
        self.name_after("server", key)
    }

    /// The session in the key of a session, `None` for any other key.
    pub fn session_of<'a>(&self, key: &'a str) -> Option<&'a str> {
        self.name_after("session", key)
    }

    fn name_after<'a>(&self, kind: &str, key: &'a str) -> Option<&'a str> {
        let rest = key
            .strip_prefix(&self.prefix)?
            .strip_prefix('/')?
            .strip_prefix(kind)?
            .strip_prefix('/')?;
        rest.split('/').next().filter(|name| is_name(name))
    }
}

fn checked<'a>(what: &'static str, name: &'a str) -> Result<&'a str, KeyError> {
    if is_name(name) { Ok(name) } else { Err(KeyError { what, name: name.to_owned() }) }
}

fn is_name(name: &str) -> bool {
    (1..=KEY_NAME_BYTES_MAX).contains(&name.len())
        && name
            .bytes()
            .all(|byte| byte.is_ascii_alphanumeric() || matches!(byte, b'.' | b'_' | b'-'))
}
