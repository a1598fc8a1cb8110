//! Lets the program find the libmujoco that it was linked with.

#[expect(clippy::disallowed_methods, reason = "cargo tells a build script everything this way")]
fn main() {
    println!("cargo::rerun-if-env-changed=MUJOCO_DYNAMIC_LINK_DIR");
    if let Ok(folder) = std::env::var("MUJOCO_DYNAMIC_LINK_DIR") {
        println!("cargo::rustc-link-arg=-Wl,-rpath,{folder}");
    }
}
