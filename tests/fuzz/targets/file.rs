//! Bytes as a file in memory: what is tested is the way in that the program itself takes.

use std::cell::RefCell;
use std::path::{Path, PathBuf};

thread_local! {
    static FOLDER: RefCell<Option<tempfile::TempDir>> = const { RefCell::new(None) };
}

/// Calls `with` with the path of a file of these bytes.
pub fn with_file(name: &str, bytes: &[u8], with: impl FnOnce(&Path)) {
    let path: PathBuf = FOLDER.with_borrow_mut(|folder| {
        let memory = Path::new("/dev/shm");
        let place = if memory.is_dir() { memory.to_owned() } else { std::env::temp_dir() };
        folder.get_or_insert_with(|| tempfile::tempdir_in(place).expect("a temporary folder")).path().join(name)
    });
    std::fs::write(&path, bytes).expect("a temporary file");
    with(&path);
}

/// The dome in a file, if there is one, has texels that are finite and not negative.
#[allow(dead_code, reason = "the scenes' target reads none")]
pub fn check_dome(path: &Path) {
    if let Ok(dome) = domelight::dome::load(path, 0.0, 1.0) {
        assert_eq!(dome.texels.len(), dome.grid.len());
        assert!(dome.texels.iter().flatten().all(|v| v.is_finite() && *v >= 0.0));
    }
}

/// The decoders' panics are caught where they are called; the fuzzer's own hook would end the process before that.
pub fn let_panics_be_caught() {
    std::panic::set_hook(Box::new(|info| eprintln!("{info}")));
}
