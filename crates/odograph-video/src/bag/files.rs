//! Recordings of several files, in order: the folders of rosbag2, whose `metadata.yaml` names them,
//! and files that are compressed as a whole.

use super::chunks::ChunkReader;
use super::compression::{Compression, ZSTD_MAGIC, unpack_zstd};
use super::database::{self, Database};
use super::mcap::{self, Mcap};
use super::recording::{Message, MessageReader, Topic, Topics};
use super::rosbag1::{self, RosBag1};
use crate::file_error::{unopened, unreadable};
use crate::limits;
use crate::pictures::name_of;
use crate::temporary::TemporaryFolder;
use odograph::error::{Error, Result};
use std::fs::File;
use std::io::{BufReader, Read};
use std::path::{Path, PathBuf};

/// Name of an unpacked file in its temporary folder.
const UNPACKED: &str = "recording";

/// Largest file that a compressed one may unpack to, bytes.
const MAX_UNPACKED: u64 = 64 << 30;

/// Format of a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum BagFormat {
    Mcap,
    RosBag1,
    /// An SQLite database, which may be a recording.
    Database,
    /// A compressed file, which may be a recording.
    Zstd,
}

impl BagFormat {
    /// The format of a file with these first bytes; `None` if it cannot be a recording.
    pub fn of(head: &[u8]) -> Option<Self> {
        [
            (mcap::MAGIC, Self::Mcap),
            (rosbag1::MAGIC, Self::RosBag1),
            (database::MAGIC, Self::Database),
            (&ZSTD_MAGIC, Self::Zstd),
        ]
        .into_iter()
        .find_map(|(magic, format)| head.starts_with(magic).then_some(format))
    }

    /// The format of a file by its content.
    pub fn of_file(path: &Path) -> Result<Option<Self>> {
        let mut head = Vec::new();
        open_file(path)?.take(64).read_to_end(&mut head).map_err(unreadable)?;
        Ok(Self::of(&head))
    }
}

fn open_file(path: &Path) -> Result<File> {
    File::open(path).map_err(unopened)
}

/// An opened file, and the temporary folder that it was unpacked into.
struct OpenedPart {
    recording: Box<dyn MessageReader>,
    _unpacked: Option<TemporaryFolder>,
    /// Own index of each of its topics.
    topics: Vec<usize>,
}

fn open_part(path: &Path) -> Result<OpenedPart> {
    let (format, unpacked, whole) = match BagFormat::of_file(path)? {
        Some(BagFormat::Zstd) => {
            let (unpacked, whole) = unpack(path)?;
            (BagFormat::of_file(&unpacked.path().join(UNPACKED))?, Some(unpacked), whole)
        }
        format => (format, None, true),
    };
    let place = unpacked.as_ref().map(|folder| folder.path().join(UNPACKED));
    let place = place.as_deref().unwrap_or(path);
    let recording = match format {
        Some(BagFormat::Mcap) => {
            Box::new(ChunkReader::<Mcap>::open(open_file(place)?)?) as Box<dyn MessageReader>
        }
        Some(BagFormat::RosBag1) => Box::new(ChunkReader::<RosBag1>::open(open_file(place)?)?),
        Some(BagFormat::Database) => Box::new(Database::open(place)?),
        _ if !whole => return Err(Error::input("the compressed file is damaged or cut off")),
        _ => return Err(Error::input("this is not an MCAP file, a ROS bag or a rosbag2 database")),
    };
    Ok(OpenedPart { recording, _unpacked: unpacked, topics: Vec::new() })
}

/// Unpacks a file into a temporary folder; false if it is damaged or cut off.
fn unpack(path: &Path) -> Result<(TemporaryFolder, bool)> {
    let packed = BufReader::with_capacity(1 << 18, open_file(path)?);
    let folder = TemporaryFolder::new()?;
    let unpacked = folder.path().join(UNPACKED);
    let failed = |error| folder.explain(Error::not_written(unpacked.display(), error));
    let mut file = File::create_new(&unpacked).map_err(failed)?;
    let whole = unpack_zstd(packed, MAX_UNPACKED, &mut file, failed)?;
    Ok((folder, whole))
}

/// Whether the content of a compressed file is a recording.
pub(super) fn is_packed_recording(path: &Path) -> bool {
    let head = || -> Option<Vec<u8>> {
        let mut head = Vec::new();
        let file = BufReader::new(File::open(path).ok()?);
        let decode = || {
            let decoder = ruzstd::decoding::StreamingDecoder::new(file).ok()?;
            decoder.take(64).read_to_end(&mut head).ok()
        };
        crate::guard::guarded("file", decode).ok()??;
        Some(head)
    };
    matches!(
        head().and_then(|head| BagFormat::of(&head)),
        Some(BagFormat::Mcap | BagFormat::RosBag1 | BagFormat::Database)
    )
}

/// A recording of one or several files.
pub(super) struct Files {
    files: Vec<PathBuf>,
    topics: Topics,
    current: Option<OpenedPart>,
    /// The current message, if messages are compressed one by one.
    unpacked: Option<Vec<u8>>,
    /// The file that is opened next.
    next: usize,
    format: String,
    warnings: Vec<String>,
}

impl Files {
    /// Opens files that follow each other; there are warnings about others.
    ///
    /// Fails if the only file, or all of them, cannot be read.
    pub fn open(files: Vec<PathBuf>, warnings: Vec<String>) -> Result<Self> {
        let mut recording = Self {
            files,
            topics: Topics::default(),
            current: None,
            unpacked: None,
            next: 0,
            format: String::new(),
            warnings,
        };
        let mut failure = None;
        for index in 0..recording.files.len() {
            let mut part = match open_part(&recording.files[index]) {
                Ok(part) => part,
                Err(error) => {
                    failure.get_or_insert((index, error));
                    continue;
                }
            };
            recording.format = part.recording.format();
            recording.number(&mut part)?;
            for (topic, &own) in part.recording.topics().iter().zip(&part.topics) {
                recording.topics.all[own].add(topic.count, topic.span_ns);
            }
            if recording.files.len() == 1 {
                recording.current = Some(part);
                recording.next = 1;
            }
        }
        if let Some((index, error)) = failure {
            let name = name_of(&recording.files[index]);
            if recording.format.is_empty() {
                return Err(if recording.files.len() == 1 { error } else { error.at(name) });
            }
            recording.warnings.push(format!("{name} was left out: {error}"));
        }
        Ok(recording)
    }

    /// Opens the next file; false after the last one.
    fn open_next(&mut self) -> Result<bool> {
        while let Some(path) = self.files.get(self.next) {
            self.next += 1;
            // A file that cannot be opened was reported before.
            let Ok(mut part) = open_part(path) else { continue };
            self.number(&mut part)?;
            self.select_in(&mut part);
            self.current = Some(part);
            return Ok(true);
        }
        Ok(false)
    }

    /// Finds the own index of each topic of a file.
    fn number(&mut self, part: &mut OpenedPart) -> Result<()> {
        for topic in part.recording.topics() {
            let own = self.topics.index(&topic.name, &topic.type_name, topic.serialization.clone());
            part.topics.push(own.ok_or_else(|| Error::input("there are too many topics"))?);
        }
        Ok(())
    }

    fn select_in(&self, part: &mut OpenedPart) {
        let topics = part.recording.topics().iter().zip(&part.topics);
        let wanted: Vec<Topic> =
            topics.filter(|(_, own)| self.topics.is_wanted(**own)).map(|(topic, _)| topic.clone()).collect();
        part.recording.select(&|topic| wanted.iter().any(|other| topic.is(other)));
    }

    fn take_warnings_of_current(&mut self) {
        let Some(part) = &mut self.current else { return };
        let name = self.next.checked_sub(1).and_then(|index| self.files.get(index)).map(|path| name_of(path));
        for warning in part.recording.take_warnings() {
            self.warnings.push(match &name {
                Some(name) if self.files.len() > 1 => format!("{name}: {warning}"),
                _ => warning,
            });
        }
    }
}

impl MessageReader for Files {
    fn format(&self) -> String {
        match self.files.len() {
            1 => self.format.clone(),
            count => format!("{} in {count} files", self.format),
        }
    }

    fn topics(&self) -> &[Topic] {
        &self.topics.all
    }

    fn select(&mut self, wanted: &dyn Fn(&Topic) -> bool) {
        self.topics.select(wanted);
        if let Some(mut part) = self.current.take() {
            self.select_in(&mut part);
            self.current = Some(part);
        }
    }

    fn advance(&mut self) -> Result<bool> {
        loop {
            if let Some(part) = &mut self.current
                && part.recording.advance()?
            {
                // rosbag2 can compress messages one by one, and says so only in metadata.yaml. No
                // serialised message begins like this.
                let data = part.recording.message().data;
                self.unpacked = data.starts_with(&ZSTD_MAGIC).then(|| {
                    let mut unpacked = self.unpacked.take().unwrap_or_default();
                    // A message that is damaged is refused by its reader.
                    Compression::Zstd.decompress(data, limits::MAX_SAMPLE_BYTES, &mut unpacked);
                    unpacked
                });
                return Ok(true);
            }
            self.take_warnings_of_current();
            if self.files.len() == 1 && self.current.is_some() {
                // It is kept for reading it again.
                return Ok(false);
            }
            self.current = None;
            if !self.open_next()? {
                return Ok(false);
            }
        }
    }

    fn message(&self) -> Message<'_> {
        match &self.current {
            Some(part) => {
                let message = part.recording.message();
                let topic = part.topics.get(message.topic).copied().unwrap_or(0);
                let data = self.unpacked.as_deref().unwrap_or(message.data);
                Message { topic, data, ..message }
            }
            None => Message { topic: 0, log_ns: 0, data: &[] },
        }
    }

    fn rewind(&mut self) -> Result<()> {
        match &mut self.current {
            // The first file may have been unpacked.
            Some(part) if self.next == 1 => part.recording.rewind(),
            _ => {
                self.current = None;
                self.next = 0;
                Ok(())
            }
        }
    }

    fn take_warnings(&mut self) -> Vec<String> {
        self.take_warnings_of_current();
        std::mem::take(&mut self.warnings)
    }
}
