//! One zenoh session: what it connects to, where it listens, and the servers that it sees.

use std::net::{Ipv4Addr, TcpListener};
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Context, anyhow, bail, ensure};
use protocol::{Keys, transport};
use rustix::process::{Resource, getrlimit};
use tempfile::TempDir;
use tokio::net::TcpStream;
use zenoh::Session;

use super::discovery::{Discovery, Fleet};
use super::local_endpoint::{ANY_LOOPBACK_PORT, local_endpoint};

/// Another process may take a port between its choice and its use.
const PORT_ATTEMPTS_MAX: usize = 10;
/// Timeout for the zenoh handshake with a router or server.
const CLIENT_WAIT_MS: u32 = 10_000;
/// Timeout for the TCP connection: a router or server that is starting may listen a little later.
const LISTENER_WAIT: Duration = Duration::from_secs(5);
/// Pause between two attempts to connect.
const LISTENER_PAUSE: Duration = Duration::from_millis(250);
/// For zenoh's threads and sockets and a few servers' pipes.
const OPEN_FILES_MIN: u64 = 64;

/// Where the network lies. Nothing is opened that is not named here.
#[derive(Debug, Clone)]
pub struct NetworkOptions {
    /// Routers or servers elsewhere, as `tcp/host:port`.
    pub connect: Vec<String>,
    /// Listen where programs of this machine can connect to. On Unix that is a socket in a folder that only this user may
    /// open, which costs a reply less than TCP does; elsewhere a free port of the loopback interface.
    pub listen_here: bool,
    /// Endpoints that others may connect to; `tcp/127.0.0.1:0` takes a free port.
    pub listen: Vec<String>,
    /// Namespace: peers see each other only within the same fleet.
    pub fleet: String,
    /// Find others on the local network by multicast; without `listen`, listens on every interface.
    pub multicast: bool,
    /// How long things may take.
    pub timing: Timing,
}

/// How long things may take.
#[derive(Debug, Clone, Copy)]
pub struct Timing {
    /// A request is sent again when no reply came for this long, then for twice as long, and so on.
    pub resend: Duration,
    /// The longest such wait.
    pub resend_max: Duration,
    /// A server whose heartbeat is silent for this long is stuck.
    pub silence_max: Duration,
    /// No reply takes longer than this, whatever the heartbeat says.
    pub reply_max: Duration,
    /// A session is opened within this time, and its first reset and step answered without a heartbeat in between: the
    /// server may have to load or to compile something first.
    pub open_max: Duration,
    /// A link that comes back within this time costs no episode: servers keep a session for as long.
    pub link_max: Duration,
}

/// A handle to one zenoh session; clones share it.
#[derive(Debug, Clone)]
pub struct Network {
    pub(super) session: Session,
    pub(super) keys: Keys,
    pub(super) discovery: Arc<Discovery>,
    pub(super) timing: Timing,
    listening: Vec<String>,
    is_remote: bool,
    /// Holds the socket; goes with the last clone.
    _folder: Option<Arc<TempDir>>,
}

impl Default for NetworkOptions {
    /// Listens on this machine alone.
    fn default() -> Self {
        Self {
            connect: Vec::new(),
            listen_here: true,
            listen: Vec::new(),
            fleet: "local".to_owned(),
            multicast: false,
            timing: Timing::default(),
        }
    }
}

impl Default for Timing {
    fn default() -> Self {
        Self {
            resend: Duration::from_millis(500),
            resend_max: Duration::from_secs(4),
            silence_max: Duration::from_secs(15),
            reply_max: Duration::from_secs(120),
            open_max: Duration::from_secs(60),
            link_max: Duration::from_secs(10),
        }
    }
}

impl Network {
    /// Opens the session. Needs a tokio runtime with several threads.
    pub async fn open(options: NetworkOptions) -> anyhow::Result<Self> {
        let keys = Keys::new(&options.fleet)?;
        ensure_open_files()?;
        options
            .connect
            .iter()
            .chain(&options.listen)
            .try_for_each(|place| check_endpoint(place))?;
        check_connections(&options.connect).await?;
        let here = options.listen_here.then(|| local_endpoint(&tempfile::env::temp_dir()));
        let here = here.transpose()?;
        let (here, folder) = here.unzip();
        let listen: Vec<String> = here.into_iter().chain(options.listen.clone()).collect();
        let (session, listening) = open_session(&options, &listen).await?;
        let discovery = Discovery::watch(&session, &keys).await?;
        let timing = options.timing;
        Ok(Self {
            session,
            keys,
            discovery,
            timing,
            listening,
            is_remote: !options.connect.is_empty() || !options.listen.is_empty(),
            _folder: folder.flatten().map(Arc::new),
        })
    }

    /// The endpoints that servers can connect to, free ports filled in; the one on this machine comes first.
    pub fn listening(&self) -> &[String] {
        &self.listening
    }

    /// The servers that are alive, from now on.
    pub fn fleet(&self) -> tokio::sync::watch::Receiver<Fleet> {
        self.discovery.fleet()
    }

    /// Waits until `count` servers have described themselves, or until `wait` is over; what is known then.
    pub async fn servers(&self, count: usize, wait: Duration) -> Fleet {
        let mut fleet = self.fleet();
        let is_complete = |fleet: &Fleet| fleet.servers.len() >= count;
        // Neither the time's end nor the network's is an error here: the caller sees who is there.
        let _ = tokio::time::timeout(wait, fleet.wait_for(is_complete)).await;
        fleet.borrow().clone()
    }

    /// When a server's simulation last moved, if it was ever heard of.
    pub fn last_beat(&self, server: &str) -> Option<std::time::Instant> {
        self.discovery.status(server).borrow().beaten_at.map(tokio::time::Instant::into_std)
    }

    /// Whether servers are reached over a link of their own, which may fail without them.
    pub(super) fn is_remote(&self) -> bool {
        self.is_remote
    }

    /// Whether anything is connected: without a router or a server at the other end, silence says nothing about servers.
    pub async fn is_connected(&self) -> bool {
        let info = self.session.info();
        info.routers_zid().await.next().is_some() || info.peers_zid().await.next().is_some()
    }

    /// Ends the session; peers that watch this agent's tokens see it at once.
    pub async fn close(self) -> anyhow::Result<()> {
        self.session
            .close()
            .await
            .map_err(|error| anyhow!("cannot close the network: {}", transport::in_words(error)))
    }
}

/// With fewer, zenoh panics.
fn ensure_open_files() -> anyhow::Result<()> {
    let limit = getrlimit(Resource::Nofile).current.unwrap_or(u64::MAX);
    ensure!(
        limit >= OPEN_FILES_MIN,
        "expected a limit of at least {OPEN_FILES_MIN} open files, got {limit}, see `ulimit -n`"
    );
    Ok(())
}

/// An error for an endpoint that this program has no transport for; zenoh would try it for as long as it may.
pub fn check_endpoint(endpoint: &str) -> anyhow::Result<()> {
    let is_known = match endpoint.split_once('/') {
        Some(("tcp", address)) => address
            .rsplit_once(':')
            .is_some_and(|(host, port)| !host.is_empty() && port.parse::<u16>().is_ok()),
        Some(("unixsock-stream", path)) => !path.is_empty(),
        _ => false,
    };
    ensure!(is_known, "endpoint {endpoint}: expected tcp/HOST:PORT or unixsock-stream/PATH");
    Ok(())
}

/// Fails if a host name is unknown or nothing listens at any of the endpoints. zenoh would retry both until its timeout and
/// report neither.
async fn check_connections(endpoints: &[String]) -> anyhow::Result<()> {
    let addresses: Vec<&str> =
        endpoints.iter().filter_map(|endpoint| endpoint.strip_prefix("tcp/")).collect();
    for address in &addresses {
        let known = tokio::net::lookup_host(address).await;
        known.map(drop).map_err(|error| anyhow!("cannot connect to {address}: {error}"))?;
    }
    if addresses.len() < endpoints.len() || addresses.is_empty() {
        return Ok(());
    }
    let begun = Instant::now();
    loop {
        let mut refusals = Vec::new();
        for address in &addresses {
            match tokio::time::timeout(LISTENER_WAIT, TcpStream::connect(address)).await {
                Ok(Ok(_)) => return Ok(()),
                Ok(Err(error)) => {
                    refusals.push(format!("{address}: {}", transport::in_words(error)))
                }
                Err(_) => refusals.push(format!("{address}: no answer")),
            }
        }
        if begun.elapsed() >= LISTENER_WAIT {
            bail!(
                "cannot connect to {}; expected an environment server or a zenoh router that listens there",
                refusals.join(", ")
            );
        }
        #[expect(
            clippy::disallowed_methods,
            reason = "no event tells when another program starts to listen"
        )]
        tokio::time::sleep(LISTENER_PAUSE).await;
    }
}

async fn open_session(
    options: &NetworkOptions,
    listen: &[String],
) -> anyhow::Result<(Session, Vec<String>)> {
    let mut attempt = 1;
    loop {
        let listening = with_ports(listen)?;
        let configuration = configuration(options, &listening)?;
        match zenoh::open(configuration).await {
            Ok(session) => return Ok((session, listening)),
            Err(error) if listening == listen || attempt == PORT_ATTEMPTS_MAX => {
                let reason = transport::in_words(error);
                return Err(match &options.connect[..] {
                    [] => anyhow!("cannot listen on {}: {reason}", listening.join(", ")),
                    connect => anyhow!(
                        "cannot connect to {}: the program that listens there does not speak zenoh ({reason})",
                        connect.join(", ")
                    ),
                });
            }
            Err(_) => attempt += 1,
        }
    }
}

fn with_ports(endpoints: &[String]) -> anyhow::Result<Vec<String>> {
    let filled = |endpoint: &String| {
        if endpoint != ANY_LOOPBACK_PORT {
            return Ok(endpoint.clone());
        }
        let listener =
            TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).context("no free port on 127.0.0.1")?;
        Ok(format!("tcp/{}", listener.local_addr().context("a bound listener has an address")?))
    };
    endpoints.iter().map(filled).collect()
}

fn configuration(options: &NetworkOptions, listening: &[String]) -> anyhow::Result<zenoh::Config> {
    let NetworkOptions { connect, multicast, .. } = options;
    let mut configuration = zenoh::Config::default();
    let bytes_max = protocol::limits::MESSAGE_BYTES_MAX;
    for (key, value) in
        transport::settings(connect, listening, *multicast, CLIENT_WAIT_MS, bytes_max)
    {
        configuration.insert_json5(key, &value).map_err(|error| {
            anyhow!("zenoh rejects the setting {key} = {value}: {}", transport::in_words(error))
        })?;
    }
    Ok(configuration)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn endpoints_without_a_transport_are_refused() {
        for known in ["tcp/localhost:7447", "tcp/[::1]:0", "unixsock-stream//tmp/socket"] {
            assert!(check_endpoint(known).is_ok(), "{known}");
        }
        for unknown in
            ["", "localhost:7447", "tcp/localhost", "tcp/:1", "tcp/a:99999", "tls/a:1", "udp/a:1"]
        {
            let error = check_endpoint(unknown).expect_err("no transport").to_string();
            assert!(
                error.starts_with(&format!("endpoint {unknown}: expected tcp/HOST:PORT")),
                "{error}"
            );
        }
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn a_host_that_nobody_knows_is_named_at_once() {
        let begun = std::time::Instant::now();
        let connect = vec!["tcp/host.invalid:7447".to_owned()];
        let options = NetworkOptions { connect, listen_here: false, ..NetworkOptions::default() };
        let error = Network::open(options).await.expect_err("no such host").to_string();
        assert!(error.starts_with("cannot connect to host.invalid:7447: "), "{error}");
        assert!(begun.elapsed() < Duration::from_secs(20), "{:?}", begun.elapsed());
    }
}
