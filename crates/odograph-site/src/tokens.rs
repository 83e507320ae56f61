//! The robots' tokens: a file of their hashes in the folder of the site.

use odograph::error::{Error, Result};
use odograph_live::server::access::{random_token, same};
use odograph_map::check_name;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::fs::{self, File, OpenOptions};
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

/// Length of a robot's token, bytes.
const TOKEN_BYTES: usize = 32;
/// Largest file that is read, bytes: some hundred thousand robots.
const MAX_FILE: u64 = 16 << 20;

/// The tokens in the folder of a site.
///
/// A token is random, is shown once, and only its SHA-256 is stored. The file is written as a whole
/// under another name and renamed, so that a running site reads the old one or the new one.
#[derive(Debug, Clone)]
pub struct RobotTokens {
    folder: PathBuf,
}

/// A robot that has, or had, a token of its own.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TokenOfRobot {
    /// Name of the robot.
    pub robot: String,
    /// Whether the token is no longer accepted.
    pub is_revoked: bool,
}

/// The content of the file.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct TokenHashes {
    robots: BTreeMap<String, TokenHash>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct TokenHash {
    /// SHA-256 of the token, hexadecimal.
    sha256: String,
    revoked: bool,
}

impl RobotTokens {
    /// Those of the site in a folder.
    pub fn in_folder(folder: &Path) -> Self {
        Self { folder: folder.to_owned() }
    }

    /// Makes a token for a robot that has none, or whose token is revoked, and returns it.
    ///
    /// # Errors
    /// If the robot has a token, if its name is invalid, or if the file cannot be read or written.
    pub fn add(&self, robot: &str) -> Result<String> {
        check_name(robot)?;
        self.change(|hashes| {
            if hashes.robots.get(robot).is_some_and(|hash| !hash.revoked) {
                return Err(Error::usage(format!(
                    "robot {robot} has a token already, which only it knows; revoke that first with odograph site \
                     token revoke"
                )));
            }
            let token = random_token::<TOKEN_BYTES>()?;
            hashes.robots.insert(robot.to_owned(), TokenHash { sha256: sha256(&token), revoked: false });
            Ok(token)
        })
    }

    /// Revokes the token of a robot. A running site refuses it from its next request on.
    ///
    /// # Errors
    /// If the robot has no token, or if the file cannot be read or written.
    pub fn revoke(&self, robot: &str) -> Result<()> {
        // Nothing is made in a folder that is no site.
        if !self.list()?.iter().any(|of| of.robot == robot) {
            return Err(Error::usage(format!(
                "no robot {} has a token of the site in {}; odograph site token list names those that have",
                shown(robot),
                self.folder.display()
            )));
        }
        self.change(|hashes| {
            // Tokens are never removed.
            hashes.robots.entry(robot.to_owned()).and_modify(|hash| hash.revoked = true);
            Ok(())
        })
    }

    /// All robots that have or had a token, by name.
    ///
    /// # Errors
    /// If the file cannot be read, or is damaged.
    pub fn list(&self) -> Result<Vec<TokenOfRobot>> {
        self.check_folder()?;
        let hashes = self.parsed(self.bytes()?.as_deref())?;
        let of_robot = |(robot, hash): (String, TokenHash)| TokenOfRobot { robot, is_revoked: hash.revoked };
        Ok(hashes.robots.into_iter().map(of_robot).collect())
    }

    fn path(&self) -> PathBuf {
        self.folder.join("tokens.json")
    }

    fn check_folder(&self) -> Result<()> {
        match self.folder.is_dir() {
            true => Ok(()),
            false => Err(Error::usage(format!(
                "there is no site in {}; give the folder of odograph site serve, or make it first",
                self.folder.display()
            ))),
        }
    }

    /// Changes the file while no other program does. With an error it stays as it is.
    fn change<T>(&self, change: impl FnOnce(&mut TokenHashes) -> Result<T>) -> Result<T> {
        self.check_folder()?;
        let path = self.path();
        let cannot = |error| Error::not_written(path.display(), error);
        // A lock on the file itself would go with the file that is replaced.
        let lock =
            private().create(true).truncate(false).open(self.folder.join("tokens.lock")).map_err(cannot)?;
        lock.lock().or_else(without_locks).map_err(cannot)?;
        let mut hashes = self.parsed(self.bytes()?.as_deref())?;
        let changed = change(&mut hashes)?;
        let text = serde_json::to_string_pretty(&hashes)
            .map_err(|error| Error::output(format!("the tokens cannot be written: {error}")))?;
        let beside = self.folder.join("tokens.json.part");
        // What a killed program has left may have any permissions.
        let _ = fs::remove_file(&beside);
        let written = private()
            .create_new(true)
            .open(&beside)
            .and_then(|mut file| file.write_all(text.as_bytes()).and_then(|()| file.sync_all()))
            .and_then(|()| fs::rename(&beside, &path));
        written.inspect_err(|_| drop(fs::remove_file(&beside))).map_err(cannot)?;
        // The name is on disk, too: what is revoked stays revoked when the power fails.
        if cfg!(unix) {
            File::open(&self.folder).and_then(|folder| folder.sync_all()).map_err(cannot)?;
        }
        Ok(changed)
    }

    /// The bytes of the file; `None` where there is no file.
    fn bytes(&self) -> Result<Option<Vec<u8>>> {
        let mut bytes = Vec::new();
        let read = File::open(self.path()).and_then(|file| file.take(MAX_FILE + 1).read_to_end(&mut bytes));
        match read {
            Ok(length) if length as u64 > MAX_FILE => Err(self.damaged("it is too large")),
            Ok(_) => Ok(Some(bytes)),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
            Err(error) => Err(Error::input(format!("{} cannot be read: {error}", self.path().display()))),
        }
    }

    fn parsed(&self, bytes: Option<&[u8]>) -> Result<TokenHashes> {
        let Some(bytes) = bytes else { return Ok(TokenHashes::default()) };
        let hashes: TokenHashes =
            serde_json::from_slice(bytes).map_err(|error| self.damaged(&error.to_string()))?;
        let is_hash = |hash: &TokenHash| hash.sha256.len() == 64;
        match hashes.robots.iter().find(|(robot, hash)| check_name(robot).is_err() || !is_hash(hash)) {
            Some((robot, _)) => Err(self.damaged(&format!("the entry of {} is invalid", shown(robot)))),
            None => Ok(hashes),
        }
    }

    fn damaged(&self, what: &str) -> Error {
        Error::input(format!(
            "the robots' tokens in {} cannot be read: {what}; restore the file from a backup, or remove it and \
             give every robot a new token",
            self.path().display()
        ))
    }
}

/// A robot to which a token belongs.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Owner {
    /// The token is valid.
    Robot(String),
    /// The token was revoked.
    Revoked(String),
}

impl TokenHashes {
    /// Whose token it is. Every hash is compared, each in constant time.
    pub fn owner(&self, token: &str) -> Option<Owner> {
        let given = sha256(token);
        let mut owner = None;
        for (robot, hash) in &self.robots {
            if same(given.as_bytes(), hash.sha256.as_bytes()) {
                owner = Some((robot, hash.revoked));
            }
        }
        owner.map(|(robot, revoked)| match revoked {
            true => Owner::Revoked(robot.clone()),
            false => Owner::Robot(robot.clone()),
        })
    }

    /// Whether a robot has, or had, a token of its own.
    pub fn has(&self, robot: &str) -> bool {
        self.robots.contains_key(robot)
    }
}

/// The tokens as a running site reads them: again for every request, so that a token that is
/// revoked is refused at once, and parsed only where the file has changed.
#[derive(Debug)]
pub(crate) struct CurrentTokens {
    tokens: RobotTokens,
    parsed: Mutex<(Option<Vec<u8>>, Arc<TokenHashes>)>,
}

impl CurrentTokens {
    pub fn in_folder(folder: &Path) -> Self {
        Self { tokens: RobotTokens::in_folder(folder), parsed: Mutex::default() }
    }

    /// The tokens now. Fails if the file cannot be read, or is damaged.
    pub fn now(&self) -> Result<Arc<TokenHashes>> {
        let bytes = self.tokens.bytes()?;
        let mut parsed = self.parsed.lock().unwrap_or_else(PoisonError::into_inner);
        if parsed.0 != bytes {
            let hashes = Arc::new(self.tokens.parsed(bytes.as_deref())?);
            *parsed = (bytes, hashes);
        }
        Ok(Arc::clone(&parsed.1))
    }
}

/// Options of a new file that only its owner can read and write.
fn private() -> OpenOptions {
    let mut options = OpenOptions::new();
    options.write(true);
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::mode(&mut options, 0o600);
    options
}

/// A file system without locks offers no better protection.
fn without_locks(error: io::Error) -> io::Result<()> {
    if error.kind() == io::ErrorKind::Unsupported { Ok(()) } else { Err(error) }
}

fn sha256(token: &str) -> String {
    Sha256::digest(token.as_bytes()).iter().map(|byte| format!("{byte:02x}")).collect()
}

/// What was given as the name of a robot, fit for a message.
fn shown(name: &str) -> String {
    name.chars().take(64).filter(|letter| !letter.is_control()).collect()
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a test fails by panicking
mod tests {
    use super::*;

    #[test]
    fn a_token_is_stored_as_its_hash_for_its_owner_alone() {
        let folder = tempfile::tempdir().unwrap();
        let tokens = RobotTokens::in_folder(folder.path());
        assert_eq!(tokens.list().unwrap(), []);
        let (a, b) = (tokens.add("a").unwrap(), tokens.add("b").unwrap());
        assert!(a.len() == 64 && a != b);
        let path = folder.path().join("tokens.json");
        let text = fs::read_to_string(&path).unwrap();
        assert!(!text.contains(&a) && text.contains(&sha256(&a)), "{text}");
        #[cfg(unix)]
        {
            use std::os::unix::fs::PermissionsExt;
            assert_eq!(fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o600);
        }
        // FIPS 180-4, the example of one block.
        assert_eq!(sha256("abc"), "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad");
        let again = tokens.add("a").unwrap_err().to_string();
        assert!(again.contains("has a token already") && !again.contains(&a), "{again}");
        assert!(tokens.add("../a").is_err() && tokens.revoke("c").is_err());
        assert_eq!(fs::read_to_string(&path).unwrap(), text, "what fails changes nothing");
    }

    #[test]
    fn a_revoked_token_is_known_as_revoked_until_there_is_a_new_one() {
        let folder = tempfile::tempdir().unwrap();
        let tokens = RobotTokens::in_folder(folder.path());
        let current = CurrentTokens::in_folder(folder.path());
        assert!(!current.now().unwrap().has("a"));
        let token = tokens.add("a").unwrap();
        assert_eq!(current.now().unwrap().owner(&token), Some(Owner::Robot("a".to_owned())));
        assert_eq!(current.now().unwrap().owner(&sha256(&token)), None, "the hash is no token");
        tokens.revoke("a").unwrap();
        assert_eq!(current.now().unwrap().owner(&token), Some(Owner::Revoked("a".to_owned())));
        assert_eq!(tokens.list().unwrap(), [TokenOfRobot { robot: "a".to_owned(), is_revoked: true }]);
        let new = tokens.add("a").unwrap();
        let now = current.now().unwrap();
        assert_eq!((now.owner(&token), now.owner(&new)), (None, Some(Owner::Robot("a".to_owned()))));
        assert!(now.has("a") && !now.has("b"));
    }

    #[test]
    fn tokens_that_are_added_at_the_same_time_are_all_there() {
        let folder = tempfile::tempdir().unwrap();
        let tokens = RobotTokens::in_folder(folder.path());
        std::thread::scope(|scope| {
            for robot in 0..8 {
                let tokens = &tokens;
                scope.spawn(move || tokens.add(&format!("robot-{robot}")).unwrap());
            }
        });
        assert_eq!(tokens.list().unwrap().len(), 8);
    }

    #[test]
    fn a_damaged_file_of_tokens_is_an_error_and_stays() {
        let folder = tempfile::tempdir().unwrap();
        let tokens = RobotTokens::in_folder(folder.path());
        for text in ["", "{", r#"{"robots":{"../a":{"sha256":"","revoked":false}}}"#, "[]"] {
            fs::write(folder.path().join("tokens.json"), text).unwrap();
            let complaint = tokens.list().unwrap_err().to_string();
            assert!(complaint.contains("tokens.json cannot be read"), "{complaint}");
            assert!(tokens.add("a").is_err() && CurrentTokens::in_folder(folder.path()).now().is_err());
            assert_eq!(fs::read_to_string(folder.path().join("tokens.json")).unwrap(), text);
        }
    }
}
