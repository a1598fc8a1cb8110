//! Environment servers on this machine: dependencies, start and supervision.
//!
//! ```text
//! installation  the program's own files: a checkout, or unpacked from the program
//!   python      Python for servers ─▶ packages    system_packages   software OpenGL
//!     wheel     the Python that rever was installed into by pip
//!   native      the program rever-simulator       variables         environment variables of servers
//! program       a simulator that can be started
//!   supervisor  starts, watches and restarts its processes ─▶ process
//! source        the servers of a run: local processes or endpoints
//! ```

mod installation;
mod local;
mod native;
mod packages;
mod process;
mod program;
mod python;
mod source;
mod supervisor;
mod system_packages;
mod variables;
mod wheel;

pub use installation::{Bundle, Host, Installation, Missing, data_folder};
pub use local::{LocalServerOptions, LocalServers};
pub use native::libmujoco;
pub use program::{ServerProgram, Simulator};
pub use python::{
    PythonEnvironment, development_environment, named_environment, peers_environment,
    servers_environment, simulators_environment,
};
pub use source::{Deployment, LocalSource, ServerSource};
pub use system_packages::{GL_PACKAGES, install_missing};
