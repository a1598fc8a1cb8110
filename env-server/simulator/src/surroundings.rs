//! The process's environment: variables that would choose another renderer than Mesa's software one are removed.

use std::ffi::OsStr;
use std::path::{Path, PathBuf};

use serde_json::Value;

/// Variables that choose another driver or platform.
const DRIVER_CHOICES: [&str; 3] = ["EGL_PLATFORM", "GALLIUM_DRIVER", "MESA_LOADER_DRIVER_OVERRIDE"];
const VENDOR_FILES: &str = "__EGL_VENDOR_LIBRARY_FILENAMES";
const VENDOR_FOLDERS: &str = "__EGL_VENDOR_LIBRARY_DIRS";

/// Removes them, as `rever_env/opengl.py` does; returns warnings for the user.
///
/// # Safety
///
/// No other thread may read the environment meanwhile.
pub unsafe fn isolate() -> Vec<String> {
    for name in DRIVER_CHOICES {
        // SAFETY: the caller's promise.
        unsafe { std::env::remove_var(name) };
    }
    // SAFETY: the caller's promise.
    unsafe { std::env::set_var("LIBGL_ALWAYS_SOFTWARE", "1") };
    let mut warnings = Vec::new();
    for name in [VENDOR_FILES, VENDOR_FOLDERS] {
        let Some(given) = std::env::var_os(name) else { continue };
        if !names_mesa(name, &given) {
            // SAFETY: the caller's promise.
            unsafe { std::env::remove_var(name) };
            warnings
                .push(format!("ignored {name}={}: it names no library of Mesa", given.display()));
        }
    }
    warnings
}

/// Whether vendor files of EGL, or one in these folders, load Mesa's library.
fn names_mesa(variable: &str, value: &OsStr) -> bool {
    std::env::split_paths(value)
        .flat_map(|path| if variable == VENDOR_FOLDERS { files_of(&path) } else { vec![path] })
        .any(|file| loads_mesa(&file))
}

fn files_of(folder: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    entries
        .map(|entry| entry.path())
        .filter(|path| path.extension() == Some(OsStr::new("json")))
        .collect()
}

/// A file that cannot be read loads nothing: EGL ignores it as well.
fn loads_mesa(file: &Path) -> bool {
    let Ok(content) = std::fs::read(file) else { return false };
    let vendor: Value = serde_json::from_slice(&content).unwrap_or_default();
    vendor["ICD"]["library_path"].as_str().is_some_and(|path| path.to_lowercase().contains("mesa"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn vendors_are_kept_if_one_of_them_is_mesa() {
        let folder = std::env::temp_dir().join(format!("rever-vendors-{}", std::process::id()));
        let [nvidia, mesa] = ["nvidia", "mesa"].map(|name| folder.join(name));
        for (vendor, library) in [(&nvidia, "libEGL_nvidia.so.0"), (&mesa, "libEGL_mesa.so.0")] {
            std::fs::create_dir_all(vendor).expect("a folder for the test");
            let icd = format!(r#"{{"ICD": {{"library_path": "{library}"}}}}"#);
            std::fs::write(vendor.join("vendor.json"), icd).expect("a file for the test");
            std::fs::write(vendor.join("broken.json"), "{").expect("a file for the test");
        }
        let joined = |paths: &[PathBuf]| std::env::join_paths(paths).expect("no colons");
        assert!(!names_mesa(VENDOR_FOLDERS, nvidia.as_os_str()));
        assert!(names_mesa(VENDOR_FOLDERS, &joined(&[nvidia.clone(), mesa.clone()])));
        let files = [nvidia.join("vendor.json"), mesa.join("vendor.json")];
        assert!(!names_mesa(VENDOR_FILES, &joined(&files[..1])));
        assert!(names_mesa(VENDOR_FILES, &joined(&files)));
        assert!(!names_mesa(VENDOR_FILES, OsStr::new("/nowhere/50_mesa.json")));
        std::fs::remove_dir_all(&folder).expect("the test's own folder");
    }
}
