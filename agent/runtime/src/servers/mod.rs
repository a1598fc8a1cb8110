//! Environment servers on this machine: what they need, how they are started and watched.
//!
//! ```text
//! installation  the program's own files: a checkout, or unpacked from the program
//!   python      Python for servers ─▶ packages    system_packages   software OpenGL
//!     wheel     the Python that rever was installed into by pip
//!   native      the program rever-simulator       variables         what servers see of the environment
//! program       a simulator that can be started
//!   supervisor  its processes: started, watched, started again ─▶ process
//! source        where a run's servers come from: this machine, or endpoints
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

pub use installation::{Bundle, Host, Installation, Missing};
pub use local::{LocalServerOptions, LocalServers};
pub use native::libmujoco;
pub use program::{ServerProgram, Simulator};
pub use python::{
    PythonEnvironment, development_environment, named_environment, servers_environment,
    simulators_environment,
};
pub use source::{Deployment, LocalSource, ServerSource};
pub use system_packages::GL_PACKAGES;
