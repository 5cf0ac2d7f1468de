//! What a glTF file may refer to: `data:` URIs, and files beside or below it. Anything else (the network, absolute
//! paths, `..` in any spelling) is refused: an asset from a stranger must not make the renderer read other files.

use crate::error::{Error, Result};
use std::path::{Path, PathBuf};

/// Reads a regular file whole. Directories, pipes, devices and empty files are told apart before anything is opened:
/// opening a pipe would wait for ever.
pub(super) fn read_file(path: &Path) -> Result<Vec<u8>> {
    let meta = std::fs::metadata(path).map_err(|e| Error::io(path, e))?;
    if meta.is_dir() {
        return Err(Error::asset(path, "is a directory; name the .glb or .gltf file in it"));
    }
    if !meta.is_file() {
        return Err(Error::asset(path, "is not a regular file (a pipe or a device?); copy it to a file first"));
    }
    let bytes = std::fs::read(path).map_err(|e| Error::io(path, e))?;
    if bytes.is_empty() {
        return Err(Error::asset(path, "is empty; export or copy it again"));
    }
    Ok(bytes)
}

/// Where a URI's bytes are.
#[derive(Debug, PartialEq)]
pub(super) enum Source {
    /// In the URI itself.
    Data(Vec<u8>),
    /// In a file under the asset's folder.
    File(PathBuf),
}

/// Resolves `uri`, found in the asset `asset`; the error is the message without its place.
pub(super) fn resolve(asset: &Path, uri: &str) -> std::result::Result<Source, String> {
    if let Some(data) = strip_prefix_ignoring_case(uri, "data:") {
        let (head, body) = data.split_once(',').ok_or("a data URI without a comma; export the asset again")?;
        return if head.to_ascii_lowercase().ends_with(";base64") {
            base64(body).map(Source::Data).ok_or_else(|| "a data URI with broken base64; export the asset again".into())
        } else {
            Ok(Source::Data(percent_decode(body)))
        };
    }
    let short: String = uri.chars().take(80).collect();
    let refuse = |why: &str| {
        Err(format!("refers to '{short}', {why}; put the file beside the asset and refer to it by a relative name"))
    };
    let Ok(name) = String::from_utf8(percent_decode(uri)) else {
        return refuse("which is not UTF-8 after percent-decoding");
    };
    if scheme(&name) {
        return refuse("which is not a file in the asset's folder (schemes are not followed)");
    }
    // Backslashes separate on Windows only; what is refused must not depend on the machine.
    let mut relative = PathBuf::new();
    for part in name.split(['/', '\\']) {
        match part {
            ".." => return refuse("which leaves the asset's folder"),
            "" if relative.as_os_str().is_empty() => return refuse("which is an absolute path or no name"),
            "" | "." => {}
            part if part.contains('\0') => return refuse("which is not a file name"),
            part => relative.push(part),
        }
    }
    if relative.as_os_str().is_empty() {
        return refuse("which is not a file name");
    }
    Ok(Source::File(asset.parent().unwrap_or(Path::new("")).join(relative)))
}

/// `http:`, `file:`, `C:` and the like: letters, digits, `+-.` up to a colon.
fn scheme(name: &str) -> bool {
    name.split_once(':').is_some_and(|(head, _)| {
        head.starts_with(|c: char| c.is_ascii_alphabetic())
            && head.chars().all(|c| c.is_ascii_alphanumeric() || "+-.".contains(c))
    })
}

fn strip_prefix_ignoring_case<'a>(text: &'a str, prefix: &str) -> Option<&'a str> {
    let head = text.get(..prefix.len())?;
    head.eq_ignore_ascii_case(prefix).then(|| &text[prefix.len()..])
}

/// Undoes %XX; a percent sign without two hexadecimal digits stays as it is.
fn percent_decode(text: &str) -> Vec<u8> {
    let bytes = text.as_bytes();
    let hex = |i: usize| bytes.get(i).and_then(|b| (*b as char).to_digit(16));
    let mut out = Vec::with_capacity(bytes.len());
    let mut i = 0;
    while i < bytes.len() {
        if let (b'%', Some(high), Some(low)) = (bytes[i], hex(i + 1), hex(i + 2)) {
            out.push((high * 16 + low) as u8);
            i += 3;
        } else {
            out.push(bytes[i]);
            i += 1;
        }
    }
    out
}

/// Standard and URL-safe base64, padded or not; white space is skipped.
fn base64(text: &str) -> Option<Vec<u8>> {
    let mut out = Vec::with_capacity(text.len() / 4 * 3 + 3);
    let (mut word, mut bits) = (0u32, 0);
    let mut symbols = 0usize;
    let body = text.trim_end().trim_end_matches('=');
    for byte in body.bytes().filter(|b| !b.is_ascii_whitespace()) {
        let value = match byte {
            b'A'..=b'Z' => byte - b'A',
            b'a'..=b'z' => byte - b'a' + 26,
            b'0'..=b'9' => byte - b'0' + 52,
            b'+' | b'-' => 62,
            b'/' | b'_' => 63,
            _ => return None,
        };
        word = word << 6 | u32::from(value);
        bits += 6;
        symbols += 1;
        if bits >= 8 {
            bits -= 8;
            out.push((word >> bits) as u8);
        }
    }
    // A lone symbol holds six bits: no byte ends there.
    (symbols % 4 != 1).then_some(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn resolve_here(uri: &str) -> std::result::Result<Source, String> {
        resolve(Path::new("folder/asset.gltf"), uri)
    }

    #[test]
    fn files_below_the_asset_are_found() {
        for (uri, path) in [
            ("a.bin", "folder/a.bin"),
            ("./sub/b%20c.png", "folder/sub/b c.png"),
            ("100%.png", "folder/100%.png"),
            ("a..b/..c", "folder/a..b/..c"),
        ] {
            assert_eq!(resolve_here(uri), Ok(Source::File(path.into())), "{uri}");
        }
    }

    #[test]
    fn everything_else_is_refused() {
        for uri in [
            "../a.bin",
            "a/../../b",
            "%2e%2e/a",
            "..%2Fa",
            "a\\..\\b",
            "a%5c..%5cb",
            "/etc/hostname",
            "%2Fetc/hostname",
            "\\\\host\\share",
            "C:\\a",
            "http://example.org/a",
            "https://e.org",
            "file:///etc/hostname",
            "",
            ".",
            "./",
            "a%00b",
            "%ff",
            "HTTP%3A//e.org",
        ] {
            assert!(resolve_here(uri).is_err(), "{uri}: {:?}", resolve_here(uri));
        }
    }

    #[test]
    fn data_uris_are_decoded() {
        for (uri, bytes) in [
            ("data:application/octet-stream;base64,AAEC", &[0u8, 1, 2][..]),
            ("data:;base64,AAE=", &[0, 1]),
            ("data:;base64,AAE", &[0, 1]),
            ("DATA:;BASE64,_-8=", &[255, 239]),
            ("data:,a%01b", b"a\x01b"),
        ] {
            assert_eq!(resolve_here(uri), Ok(Source::Data(bytes.to_vec())), "{uri}");
        }
        for uri in ["data:;base64", "data:;base64,A", "data:;base64,AA*A", "data:;base64,AA=A"] {
            assert!(resolve_here(uri).is_err(), "{uri}");
        }
    }
}
