//! The library's one error type. A variant a cause; every message names the file or the option, says what is wrong there
//! and what to do about it. The binary adds context with `anyhow` and prints the chain.

use std::path::{Path, PathBuf};

/// What can go wrong with a user's input, a file or a library below us.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The operating system refused to read or write a file.
    #[error("{}: {error}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said. Not a source: the message has it, and a chain would say it twice.
        error: std::io::Error,
    },
    /// A glTF asset (or one of its buffers and images) that can't be rendered; the message names place and remedy.
    #[error("{}: {message}", path.display())]
    Asset {
        /// The asset.
        path: PathBuf,
        /// Place, cause and remedy.
        message: String,
    },
    /// A dome image that can't be used.
    #[error("{}: {message}", path.display())]
    Dome {
        /// The image.
        path: PathBuf,
        /// Cause and remedy.
        message: String,
    },
    /// An image that can't be read back or compared.
    #[error("{}: {message}", path.display())]
    Image {
        /// The image.
        path: PathBuf,
        /// Cause and remedy.
        message: String,
    },
    /// A checkpoint that can't be gone on from.
    #[error("{}: {message}", path.display())]
    Checkpoint {
        /// The checkpoint.
        path: PathBuf,
        /// Cause and remedy.
        message: String,
    },
    /// A command-line value or a plugin's option outside what is known or allowed.
    #[error("{0}")]
    Option(String),
    /// An acceleration structure could not be built.
    #[error("{0}")]
    Accel(String),
}

/// The library's result.
pub type Result<T> = std::result::Result<T, Error>;

impl Error {
    /// An [`Error::Io`] at `path`.
    pub fn io(path: &Path, error: std::io::Error) -> Self {
        Self::Io { path: path.to_owned(), error }
    }
    /// An [`Error::Asset`] at `path`.
    pub fn asset(path: &Path, message: impl Into<String>) -> Self {
        Self::Asset { path: path.to_owned(), message: message.into() }
    }
    /// An [`Error::Dome`] at `path`.
    pub fn dome(path: &Path, message: impl Into<String>) -> Self {
        Self::Dome { path: path.to_owned(), message: message.into() }
    }
    /// An [`Error::Checkpoint`] at `path`.
    pub fn checkpoint(path: &Path, message: impl Into<String>) -> Self {
        Self::Checkpoint { path: path.to_owned(), message: message.into() }
    }
    /// An [`Error::Image`] at `path`.
    pub fn image(path: &Path, message: impl Into<String>) -> Self {
        Self::Image { path: path.to_owned(), message: message.into() }
    }
}
