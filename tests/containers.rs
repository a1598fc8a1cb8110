//! The container files: docker accepts them, and they agree with the rest of the repository.

use std::process::Command;

use runtime::servers::GL_PACKAGES;

use crate::harness::{repository, succeed};

#[test]
fn docker_accepts_the_compose_file() {
    let compose = Command::new("docker").args(["compose", "version"]).output();
    if !compose.is_ok_and(|output| output.status.success()) {
        eprintln!("there is no docker compose here to ask");
        return;
    }
    let mut config = Command::new("docker");
    config.args(["compose", "config", "--quiet"]).current_dir(repository());
    succeed(&mut config);
}

#[test]
fn router_agent_and_servers_use_the_same_zenoh_version() {
    let router = after(&read("docker-compose.yml"), "image: eclipse/zenoh:");
    let server = after(&read("env-server/requirements.lock"), "eclipse-zenoh==");
    let agent = after(&read("Cargo.lock"), "name = \"zenoh\"\nversion = \"");
    assert_eq!((router.as_str(), server.as_str()), (agent.as_str(), agent.as_str()));
}

#[test]
fn the_server_image_renders_with_what_the_setup_installs() {
    let image = read("env-server/Dockerfile");
    for package in GL_PACKAGES {
        assert!(image.contains(package), "{package} is not in env-server/Dockerfile");
    }
}

fn read(path: &str) -> String {
    std::fs::read_to_string(repository().join(path))
        .unwrap_or_else(|error| panic!("{path}: {error}"))
}

/// The version number after `mark`.
fn after(text: &str, mark: &str) -> String {
    let (_, rest) = text.split_once(mark).unwrap_or_else(|| panic!("no {mark:?} was found"));
    rest.chars().take_while(|character| character.is_ascii_digit() || *character == '.').collect()
}
