//! The environment variables of servers and installers.
//!
//! A server gets only those variables of the user that contain paths. Others, such as
//! `CUDA_VISIBLE_DEVICES`, `PYTHONPATH`, `MUJOCO_EGL_DEVICE_ID` and the many variables of Mesa and
//! GLVND, could change what the server renders, imports or computes, or stop it.

use std::collections::BTreeMap;
use std::ffi::{OsStr, OsString};

type Variables = BTreeMap<OsString, OsString>;

/// Paths of the user's programs, files and temporary files.
const PASSED_ON: [&str; 5] = ["HOME", "LOGNAME", "PATH", "TMPDIR", "USER"];
/// The same for every server on every machine.
const FIXED: [(&str, &str); 4] = [
    ("LC_ALL", "C.UTF-8"),
    // Images must not depend on the machine's GPU.
    ("LIBGL_ALWAYS_SOFTWARE", "1"),
    ("MUJOCO_GL", "egl"),
    // Otherwise a pipe buffers the output, including the line that starts with "ready".
    ("PYTHONUNBUFFERED", "1"),
];
/// Variables that redirect an installation or change what is installed.
const NOT_FOR_INSTALLERS: [&str; 10] = [
    "CONDA_PREFIX",
    "PIP_CONSTRAINT",
    "PIP_DRY_RUN",
    "PIP_PREFIX",
    "PIP_REQUIREMENT",
    "PIP_ROOT",
    "PIP_TARGET",
    "PIP_USER",
    "UV_PYTHON",
    "VIRTUAL_ENV",
];

/// The variables of a server.
pub(super) fn for_server(host: &Variables) -> Variables {
    let passed_on = PASSED_ON.into_iter().filter_map(|name| {
        host.get_key_value(OsStr::new(name)).map(|(name, value)| (name.clone(), value.clone()))
    });
    passed_on.chain(FIXED.map(|(name, value)| (name.into(), value.into()))).collect()
}

/// The variables of pip and uv, which need the user's proxies, package indices and certificates.
pub(super) fn for_installer(host: &Variables) -> Variables {
    let mut variables = host.clone();
    variables.retain(|name, _| {
        let name = name.to_string_lossy();
        !name.starts_with("PYTHON") && !NOT_FOR_INSTALLERS.contains(&name.as_ref())
    });
    variables
}

#[cfg(test)]
mod tests {
    use super::*;

    fn variables(names: &[&str]) -> Variables {
        names.iter().map(|name| (OsString::from(name), OsString::from("/user"))).collect()
    }

    fn names(variables: &Variables) -> Vec<&str> {
        variables.keys().filter_map(|name| name.to_str()).collect()
    }

    #[test]
    fn a_server_gets_only_paths_of_the_user() {
        let host = variables(&[
            "CUDA_VISIBLE_DEVICES",
            "DISPLAY",
            "HOME",
            "LD_PRELOAD",
            "LIBGL_ALWAYS_SOFTWARE",
            "PATH",
            "PYTHONPATH",
            "__EGL_VENDOR_LIBRARY_FILENAMES",
        ]);
        let seen = for_server(&host);
        let expected =
            ["HOME", "LC_ALL", "LIBGL_ALWAYS_SOFTWARE", "MUJOCO_GL", "PATH", "PYTHONUNBUFFERED"];
        assert_eq!(names(&seen), expected);
        assert_eq!(seen[OsStr::new("LIBGL_ALWAYS_SOFTWARE")], "1");
        assert_eq!(seen[OsStr::new("HOME")], "/user");
    }

    #[test]
    fn an_installer_gets_the_package_index_but_no_other_target() {
        let host =
            variables(&["HTTPS_PROXY", "PIP_INDEX_URL", "PIP_TARGET", "PYTHONHOME", "VIRTUAL_ENV"]);
        assert_eq!(names(&for_installer(&host)), ["HTTPS_PROXY", "PIP_INDEX_URL"]);
    }
}
