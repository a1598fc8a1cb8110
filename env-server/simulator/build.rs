//! Lets the program find the libmujoco that it was linked with.

#[expect(clippy::disallowed_methods, reason = "cargo tells a build script everything this way")]
fn main() {
    println!("cargo::rerun-if-changed=../assets");
    println!("cargo::rerun-if-env-changed=MUJOCO_DYNAMIC_LINK_DIR");
    // Beside the program, for one that was copied; and where it was linked.
    println!("cargo::rustc-link-arg=-Wl,-rpath,$ORIGIN");
    if let Ok(folder) = std::env::var("MUJOCO_DYNAMIC_LINK_DIR") {
        println!("cargo::rustc-link-arg=-Wl,-rpath,{folder}");
    }
}
