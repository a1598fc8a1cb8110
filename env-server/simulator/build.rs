//! Sets the search path of libmujoco in the program.

#[expect(clippy::disallowed_methods, reason = "cargo tells a build script everything this way")]
fn main() {
    println!("cargo::rerun-if-changed=../assets");
    println!("cargo::rerun-if-env-changed=MUJOCO_DYNAMIC_LINK_DIR");
    // The program's own folder, for a copied program, and the folder of the library at link time.
    println!("cargo::rustc-link-arg=-Wl,-rpath,$ORIGIN");
    if let Ok(folder) = std::env::var("MUJOCO_DYNAMIC_LINK_DIR") {
        println!("cargo::rustc-link-arg=-Wl,-rpath,{folder}");
    }
}
