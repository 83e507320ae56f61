//! Profiles: a camera and its mount, kept under a name in the configuration folder of the user.

use odograph::error::{Error, Result};
use odograph_session::files;
use serde::{Deserialize, Serialize};
use std::env;
use std::fs;
use std::path::{Path, PathBuf};

/// What a profile keeps. Paths are absolute, so that it holds in any folder.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Profile {
    /// Camera file.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub camera: Option<PathBuf>,
    /// Width and height of the ground in the image, metres.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub field_of_view_m: Option<(f64, f64)>,
    /// Rig file.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rig: Option<PathBuf>,
    /// Height of the camera above the ground, metres.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub height_m: Option<f64>,
    /// Readout time of the image, milliseconds.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub readout_ms: Option<f64>,
    /// Mask of what is not ground.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mask: Option<PathBuf>,
}

/// Ending of a profile's file.
const EXTENSION: &str = "toml";

/// Longest name of a profile.
const LONGEST_NAME: usize = 64;

/// The folder of the profiles: `odograph/profiles` in `XDG_CONFIG_HOME`, else in `~/.config`; on
/// Windows in `APPDATA`.
pub fn folder() -> Result<PathBuf> {
    let of = |name: &str| env::var_os(name).map(PathBuf::from).filter(|path| path.is_absolute());
    let config = of("XDG_CONFIG_HOME")
        .or_else(|| of("APPDATA").filter(|_| cfg!(windows)))
        .or_else(|| Some(of("HOME")?.join(".config")))
        .ok_or_else(|| {
            Error::input("there is no folder for profiles: set HOME or XDG_CONFIG_HOME to an absolute path")
        })?;
    Ok(config.join("odograph").join("profiles"))
}

/// The file of a profile; fails if the name cannot be one.
pub fn file(name: &str) -> Result<PathBuf> {
    let may_be = |c: char| c.is_alphanumeric() || matches!(c, '-' | '_' | '.');
    let is_name = !name.is_empty()
        && name.chars().count() <= LONGEST_NAME
        && name.chars().all(may_be)
        && !name.starts_with(['.', '-']);
    if !is_name {
        return Err(Error::usage(format!(
            "`{name}` is no name of a profile; use up to {LONGEST_NAME} letters, digits, hyphens, underscores and dots, \
             beginning with a letter or digit"
        )));
    }
    Ok(folder()?.join(format!("{name}.{EXTENSION}")))
}

/// The names of all profiles, sorted.
pub fn names() -> Result<Vec<String>> {
    let folder = folder()?;
    let entries = match fs::read_dir(&folder) {
        Ok(entries) => entries,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(Vec::new()),
        Err(error) => return Err(Error::input(format!("{} cannot be read: {error}", folder.display()))),
    };
    let name = |path: PathBuf| {
        let name = path.file_stem()?.to_str()?.to_owned();
        (path.extension()? == EXTENSION && file(&name).is_ok()).then_some(name)
    };
    let mut names: Vec<String> = entries.flatten().filter_map(|entry| name(entry.path())).collect();
    names.sort();
    Ok(names)
}

/// Reads a profile; what it names must be there.
pub fn read(name: &str) -> Result<Profile> {
    let profile = read_unchecked(name)?;
    let named = [("camera", &profile.camera), ("rig", &profile.rig), ("mask", &profile.mask)];
    for (what, path) in named.into_iter().filter_map(|(what, path)| Some((what, path.as_ref()?))) {
        if !path.is_file() {
            return Err(Error::input(format!(
                "the {what} file of the profile {name}, {}, is no longer there; save the profile again with --force",
                path.display()
            )));
        }
    }
    Ok(profile)
}

/// Reads a profile as it was saved.
pub fn read_unchecked(name: &str) -> Result<Profile> {
    let path = file(name)?;
    if !path.exists() {
        let names = names()?;
        let there = match names.is_empty() {
            true => "there are none yet; odograph profile save makes one".to_owned(),
            false => format!("the saved profiles are: {}", names.join(", ")),
        };
        return Err(Error::input(format!("there is no profile named {name}; {there}")));
    }
    toml::from_str(&files::read_text(&path)?).map_err(|error| {
        let why = error.message().replace('\n', ", ");
        Error::input(format!("{} is not a profile: {why}", path.display()))
    })
}

/// A profile as the text of its file.
pub fn text(profile: &Profile) -> Result<String> {
    toml::to_string(profile)
        .map_err(|error| Error::output(format!("the profile cannot be written as TOML: {error}")))
}

/// An absolute path for what a person typed relative to the working folder.
pub fn absolute(path: &Path) -> Result<PathBuf> {
    std::path::absolute(path)
        .map_err(|error| Error::input(format!("{} has no absolute path: {error}", path.display())))
}
