//! Files that are there whole or not at all, and bad paths found out before hours of rendering.

use crate::error::{Error, Result};
use std::fs::{self, File, OpenOptions};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU32, Ordering};

/// Writes `path` through `write`: to a temporary file in the same folder, renamed when all of it is written. On an
/// error the temporary file is removed and what was at `path` stays. Devices and pipes are written to directly.
pub fn write_atomically(path: &Path, write: impl FnOnce(&mut BufWriter<File>) -> io::Result<()>) -> Result<()> {
    let fail = |e| Error::io(path, e);
    let run = |file: File| {
        let mut buffered = BufWriter::new(file);
        write(&mut buffered)?;
        // Dropping would flush too, and lose the error of a full disk.
        buffered.flush()
    };
    let target = resolve(path);
    if fs::metadata(&target).is_ok_and(|m| !m.is_file() && !m.is_dir()) {
        return OpenOptions::new().write(true).open(&target).and_then(run).map_err(fail);
    }
    if target.is_dir() || target.file_name().is_none() {
        return Err(fail(io::Error::other("this is a directory; give a file name in it")));
    }
    let (temporary, file) = create_beside(&target).map_err(fail)?;
    run(file).and_then(|()| fs::rename(&temporary, &target)).map_err(|e| {
        // The first error is the one to report.
        let _ = fs::remove_file(&temporary);
        fail(e)
    })
}

/// Fails as a later [`write_atomically`] would: no such folder, no permission, a directory in the way. Changes nothing.
pub fn check_writable(path: &Path) -> Result<()> {
    let fail = |e| Error::io(path, e);
    let target = resolve(path);
    if target.is_dir() || target.file_name().is_none() {
        return Err(fail(io::Error::other("this is a directory; give a file name in it")));
    }
    if let Ok(meta) = fs::metadata(&target) {
        if meta.is_file() || !is_pipe(&meta) {
            OpenOptions::new().write(true).open(&target).map_err(fail)?;
        }
        if !meta.is_file() {
            return Ok(());
        }
    }
    let (temporary, _) = create_beside(&target).map_err(fail)?;
    fs::remove_file(&temporary).map_err(fail)
}

/// Opening a FIFO would wait for a reader.
fn is_pipe(meta: &fs::Metadata) -> bool {
    use std::os::unix::fs::FileTypeExt;
    meta.file_type().is_fifo()
}

/// The file a symbolic link leads to: renaming onto the link would replace the link.
fn resolve(path: &Path) -> PathBuf {
    fs::canonicalize(path).unwrap_or_else(|_| path.to_owned())
}

/// A new file in the folder of `target`, under a name of its own for each process and call.
fn create_beside(target: &Path) -> io::Result<(PathBuf, File)> {
    static COUNT: AtomicU32 = AtomicU32::new(0);
    let folder = target.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    if !folder.is_dir() {
        let message = format!("the folder {} does not exist; create it first", folder.display());
        return Err(io::Error::new(io::ErrorKind::NotFound, message));
    }
    loop {
        let name = format!(".domelight-{}-{}.tmp", std::process::id(), COUNT.fetch_add(1, Ordering::Relaxed));
        let temporary = folder.join(name);
        match OpenOptions::new().write(true).create_new(true).open(&temporary) {
            // Left behind by a process of the same number that was killed.
            Err(e) if e.kind() == io::ErrorKind::AlreadyExists => {}
            result => return result.map(|file| (temporary, file)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_error_leaves_the_old_file_and_nothing_else() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.exr");
        write_atomically(&path, |f| f.write_all(b"old")).unwrap();
        let error = write_atomically(&path, |f| {
            f.write_all(b"new")?;
            Err(io::Error::from(io::ErrorKind::StorageFull))
        });
        assert!(error.unwrap_err().to_string().contains("a.exr"));
        assert_eq!(fs::read(&path).unwrap(), b"old");
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 1);
    }

    #[test]
    fn a_full_device_is_an_error_that_names_it() {
        let full = Path::new("/dev/full");
        if full.exists() {
            let error = write_atomically(full, |f| f.write_all(&[0; 100_000])).unwrap_err().to_string();
            assert!(error.contains("/dev/full"), "{error}");
        }
    }

    #[test]
    fn bad_paths_are_found_out_and_good_ones_left_alone() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("b.png");
        check_writable(&path).unwrap();
        assert!(!path.exists());
        assert!(check_writable(dir.path()).is_err());
        let error = check_writable(&dir.path().join("no/where.exr")).unwrap_err().to_string();
        assert!(error.contains("does not exist; create it"), "{error}");
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 0);
    }

    #[test]
    fn a_link_stays_a_link() {
        let dir = tempfile::tempdir().unwrap();
        let (real, link) = (dir.path().join("real"), dir.path().join("link"));
        fs::write(&real, "old").unwrap();
        std::os::unix::fs::symlink(&real, &link).unwrap();
        write_atomically(&link, |f| f.write_all(b"new")).unwrap();
        assert_eq!(fs::read(&real).unwrap(), b"new");
        assert!(fs::symlink_metadata(&link).unwrap().is_symlink());
    }
}
