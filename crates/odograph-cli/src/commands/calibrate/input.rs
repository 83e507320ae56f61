//! One recording, or several one after the other, as one row of frames.

use odograph::error::{Error, Result};
use odograph::image::GrayImage;
use odograph_video::{Source, SourceOptions};
use std::collections::VecDeque;
use std::path::Path;

/// A frame or image to search for the board.
pub struct SearchedImage {
    /// Its number among all that are searched, from 0.
    pub number: u64,
    /// Its name for people: the name of the picture, or the frame and its time.
    pub name: String,
    /// Its time in seconds; `None` for pictures given one by one.
    pub time_s: Option<f64>,
    /// Whether it is a picture and not the frame of a video.
    pub picture: bool,
    pub image: GrayImage,
}

/// What is looked at.
pub struct Input {
    open: Option<(Source, String)>,
    waiting: VecDeque<String>,
    options: SourceOptions,
    number: u64,
    /// Width and height of every frame, and where the first was.
    size: (usize, usize),
    first: String,
    single: bool,
    warnings: Vec<String>,
    /// How many frames there will probably be.
    pub frame_count: Option<u64>,
    /// What is read, for people.
    pub description: String,
}

impl Input {
    /// Opens the first of the sources; the others when it is their turn, so that thousands of
    /// pictures can be given.
    pub fn open(sources: &[String], options: &SourceOptions) -> Result<Self> {
        let mut waiting: VecDeque<String> = sources.iter().cloned().collect();
        let first = waiting.pop_front().ok_or_else(|| Error::usage("there is nothing to calibrate with"))?;
        if let Some(gone) = waiting.iter().find(|source| *source != "-" && !Path::new(source).exists()) {
            return Err(Error::input(format!("{gone}: there is no such file or folder")));
        }
        let source = odograph_session::open_recording(&first, options)?;
        let (info, single) = (source.info(), waiting.is_empty());
        let description = if single { first.clone() } else { format!("{first} and {} more", waiting.len()) };
        Ok(Self {
            size: (info.width, info.height),
            // Of several sources each is likely to be one picture.
            frame_count: if single { info.frame_count } else { Some(sources.len() as u64) },
            open: Some((source, first.clone())),
            waiting,
            options: options.clone(),
            number: 0,
            first,
            single,
            warnings: Vec::new(),
            description,
        })
    }

    /// What kind of recording it is, in words: codec, container, size.
    pub fn kind(&self) -> String {
        let kind = self.open.as_ref().map_or("", |(source, _)| &source.info().description);
        let several = self.waiting.len() + 1;
        if self.single { kind.to_owned() } else { format!("{several} sources, the first: {kind}") }
    }

    /// The next frame; `None` at the end.
    ///
    /// Fails if a source cannot be read or its size differs from that of the first.
    pub fn next(&mut self) -> Result<Option<SearchedImage>> {
        loop {
            let Some((source, place)) = &mut self.open else { return Ok(None) };
            if let Some(frame) = source.next_frame()? {
                let picture = frame.name.is_some();
                let name = match (frame.name, self.single) {
                    (Some(name), _) => name,
                    (None, true) => format!("frame {} ({:.2} s)", frame.number, frame.time_s),
                    (None, false) => format!("{place}, frame {}", frame.number),
                };
                self.number += 1;
                return Ok(Some(SearchedImage {
                    number: self.number - 1,
                    name,
                    // The times of several sources do not follow each other.
                    time_s: self.single.then_some(frame.time_s),
                    picture,
                    image: frame.gray,
                }));
            }
            self.warnings.append(&mut source.take_warnings());
            self.open = match self.waiting.pop_front() {
                Some(place) => Some((self.open_next(&place)?, place)),
                None => None,
            };
        }
    }

    fn open_next(&self, place: &str) -> Result<Source> {
        let source = odograph_session::open_recording(place, &self.options)?;
        let (width, height) = (source.info().width, source.info().height);
        if (width, height) != self.size {
            return Err(Error::input(format!(
                "{place} has {width}x{height} pixels, {} has {}x{}; one camera at one resolution is calibrated at a time",
                self.first, self.size.0, self.size.1
            )));
        }
        Ok(source)
    }

    /// Warnings about the sources. Missing timestamps do not matter here.
    pub fn take_warnings(&mut self) -> Vec<String> {
        if let Some((source, _)) = &mut self.open {
            self.warnings.append(&mut source.take_warnings());
        }
        let mut warnings = std::mem::take(&mut self.warnings);
        warnings.retain(|warning| !warning.contains("nothing says when the frames were taken"));
        warnings
    }
}
