//! With the feature `embree`: finds Embree, compiles the shim in `ffi/` against its header and binds the shim's own.
//!
//! Looked at, in this order: `$EMBREE_DIR`, then the usual places; `embree4/rtcore.h` before `embree3/rtcore.h`.

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    #[cfg(feature = "embree")]
    if let Err(message) = embree::build() {
        println!("cargo::error={message}");
    }
}

#[cfg(feature = "embree")]
mod embree {
    use std::path::{Path, PathBuf};

    const INSTALL: &str = "install it (Debian: apt-get install libembree-dev libclang-dev gcc), or build without Embree: \
                           cargo build --no-default-features";

    /// Where an Embree was found.
    struct Found {
        include: PathBuf,
        major: u32,
    }

    pub(crate) fn build() -> Result<(), String> {
        for watched in ["ffi/embree.h", "ffi/embree.c"] {
            println!("cargo::rerun-if-changed={watched}");
        }
        println!("cargo::rerun-if-env-changed=EMBREE_DIR");
        let root = std::env::var_os("EMBREE_DIR").map(PathBuf::from);
        let found = find(root.as_deref())?;
        compile(&found)?;
        bind()?;
        link(root.as_deref(), found.major);
        Ok(())
    }

    fn find(root: Option<&Path>) -> Result<Found, String> {
        let includes = match root {
            Some(root) => vec![root.join("include")],
            None => ["/usr/include", "/usr/local/include", "/opt/homebrew/include"].map(PathBuf::from).to_vec(),
        };
        for major in [4, 3] {
            for include in &includes {
                if include.join(format!("embree{major}/rtcore.h")).is_file() {
                    return Ok(Found { include: include.clone(), major });
                }
            }
        }
        let places: Vec<_> = includes.iter().map(|p| p.display().to_string()).collect();
        Err(format!("no embree4/rtcore.h or embree3/rtcore.h in {}: {INSTALL}", places.join(", ")))
    }

    fn compile(found: &Found) -> Result<(), String> {
        let mut shim = cc::Build::new();
        shim.file("ffi/embree.c").std("c11").include(&found.include).warnings(true).cargo_warnings(true).opt_level(3);
        if found.major == 4 {
            shim.define("DOME_EMBREE_4", None);
        }
        shim.try_compile("domelight_embree")
            .map_err(|e| format!("ffi/embree.c does not compile ({}): {INSTALL}", one_line(&e)))
    }

    fn bind() -> Result<(), String> {
        let builder = bindgen::Builder::default()
            .header("ffi/embree.h")
            .allowlist_item("dome_.*")
            .rust_edition(bindgen::RustEdition::Edition2024)
            .merge_extern_blocks(true);
        // Without libclang bindgen panics instead of returning an error.
        let generated = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| builder.generate()));
        let bindings = match generated {
            Ok(Ok(bindings)) => bindings,
            Ok(Err(error)) => return Err(format!("ffi/embree.h cannot be bound ({}): {INSTALL}", one_line(&error))),
            Err(_) => return Err(format!("libclang cannot be loaded: {INSTALL}")),
        };
        let out = std::env::var_os("OUT_DIR").map(PathBuf::from).ok_or("OUT_DIR is not set: build with cargo")?;
        bindings.write_to_file(out.join("embree.rs")).map_err(|e| format!("{}: {e}", out.display()))
    }

    /// The shim refers to Embree, so Embree comes after it.
    fn link(root: Option<&Path>, major: u32) {
        if let Some(root) = root {
            let lib = ["lib/x86_64-linux-gnu", "lib/aarch64-linux-gnu", "lib64", "lib"].map(|l| root.join(l));
            let name = format!("libembree{major}.so");
            if let Some(lib) = lib.iter().find(|l| l.join(&name).exists()) {
                println!("cargo::rustc-link-search=native={}", lib.display());
                println!("cargo::rustc-link-arg=-Wl,-rpath,{}", lib.display());
            }
            // A library of a newer system (.ci/embree4.sh) wants a newer C library than the linker sees.
            println!("cargo::rustc-link-arg=-Wl,--allow-shlib-undefined");
        }
        println!("cargo::rustc-link-lib=embree{major}");
    }

    fn one_line(error: &dyn std::fmt::Display) -> String {
        error.to_string().replace('\n', " ")
    }
}
