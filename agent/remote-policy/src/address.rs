//! The address of a policy server.

use std::fmt;
use std::str::FromStr;

use anyhow::{Result, bail, ensure};
use tokio_tungstenite::tungstenite::http::Uri;

/// The port of all three wires' own servers.
const PORT_DEFAULT: u16 = 8000;

/// What a policy server speaks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Wire {
    /// openpi's WebSocket.
    OpenPi,
    /// vla-eval's WebSocket.
    VlaEval,
    /// OpenVLA's HTTP.
    Act,
}

/// The address of a policy server.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Address {
    /// What it speaks.
    pub wire: Wire,
    /// Name or number of the host.
    pub host: String,
    /// TCP port.
    pub port: u16,
    /// Path, with the query.
    pub path: String,
}

impl Wire {
    /// The scheme of its addresses.
    pub fn scheme(self) -> &'static str {
        match self {
            Wire::OpenPi => "openpi",
            Wire::VlaEval => "vla-eval",
            Wire::Act => "http",
        }
    }
}

impl fmt::Display for Wire {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(self.scheme())
    }
}

impl Address {
    /// Whether a text is meant as an address and not as a folder.
    pub fn is_meant(text: &str) -> bool {
        text.contains("://")
    }

    /// Host and port, as for a socket or a header.
    pub fn authority(&self) -> String {
        format!("{}:{}", self.host, self.port)
    }
}

impl fmt::Display for Address {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let path = if self.path == "/" { "" } else { &self.path };
        write!(formatter, "{}://{}{path}", self.wire, self.authority())
    }
}

impl FromStr for Address {
    type Err = anyhow::Error;

    fn from_str(text: &str) -> Result<Address> {
        let forms = "expected openpi://HOST:PORT, vla-eval://HOST:PORT or http://HOST:PORT/act";
        let Ok(uri) = text.parse::<Uri>() else { bail!("{forms}, got {text:?}") };
        let wire = match uri.scheme_str() {
            Some("openpi") => Wire::OpenPi,
            Some("vla-eval") => Wire::VlaEval,
            Some("http") => Wire::Act,
            Some("https" | "wss") => bail!(
                "{forms}, got {text:?}; for an encrypted connection use a tunnel such as `ssh -L 8000:HOST:8000`"
            ),
            Some("ws") => bail!("{forms}, got {text:?}: which of the two does the server speak?"),
            _ => bail!("{forms}, got {text:?}"),
        };
        let Some(host) = uri.host().filter(|host| !host.is_empty()) else {
            bail!("{forms}, got {text:?}")
        };
        let has_user = uri.authority().is_some_and(|authority| authority.as_str().contains('@'));
        ensure!(
            !has_user,
            "{forms}, got a user's name or password in it; a key is given by its own option"
        );
        let port = match uri.port_u16() {
            Some(port) => port,
            None if uri.authority().is_some_and(|authority| authority.as_str() == host) => {
                PORT_DEFAULT
            }
            None => bail!("{forms}, got {text:?}"),
        };
        let path = uri.path_and_query().map_or("/", |path| path.as_str());
        ensure!(wire != Wire::Act || path != "/", "expected the path too, such as {text}/act");
        Ok(Address { wire, host: host.to_owned(), port, path: path.to_owned() })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_are_read_and_written_back() {
        for (text, wire, host, port, path) in [
            ("openpi://127.0.0.1:9000", Wire::OpenPi, "127.0.0.1", 9000, "/"),
            ("vla-eval://robot", Wire::VlaEval, "robot", 8000, "/"),
            ("http://[::1]:80/act?key=b", Wire::Act, "[::1]", 80, "/act?key=b"),
        ] {
            let address: Address = text.parse().expect(text);
            assert_eq!(
                (address.wire, &*address.host, address.port, &*address.path),
                (wire, host, port, path)
            );
            assert_eq!(address.to_string().parse::<Address>().expect(text), address);
        }
    }

    #[test]
    fn other_addresses_are_refused_with_the_forms() {
        for (text, expected) in [
            ("grpc://host:1", "got \"grpc://host:1\""),
            ("openpi://", "got \"openpi://\""),
            ("openpi://host:70000", "got \"openpi://host:70000\""),
            ("openpi://host:x", "got \"openpi://host:x\""),
            ("https://host/act", "for an encrypted connection use a tunnel"),
            ("ws://host:8000", "which of the two does the server speak?"),
            ("openpi://me:secret@host", "a key is given by its own option"),
            ("http://host:8000", "expected the path too, such as http://host:8000/act"),
        ] {
            let error = text.parse::<Address>().expect_err(text).to_string();
            assert!(error.contains(expected), "{error}");
        }
    }
}
