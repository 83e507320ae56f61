//! Decode | find the board | choose, side by side. The order of frames is kept, so any number of
//! threads gives the same result.

use super::input::{Input, SearchedImage};
use crate::report::calibration::{BoardDetections, Thumbnail};
use crate::{console, interrupt};
use indicatif::ProgressBar;
use odograph::error::{Error, Result};
use odograph::image::GrayImage;
use odograph_calibration::selection::{SelectionConfig, Sighting, ViewSelector, blur_px};
use odograph_calibration::{Board, BoardFinder, BoardView, NotFound, seen_instead};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex, mpsc};
use std::thread;

/// What a search has found.
pub struct BoardSearch {
    pub found: BoardDetections,
    pub selector: ViewSelector,
    /// The sightings in pictures, while there are few enough of them that all can be used.
    pub pictures: Vec<Sighting>,
    /// Names of the sightings, by their numbers.
    pub names: BTreeMap<u64, String>,
    /// Small pictures of the sightings, by their numbers.
    pub thumbnails: BTreeMap<u64, Thumbnail>,
    pub warnings: Vec<String>,
    /// What kind of recording it was, in words.
    pub kind: String,
    /// Some of the images without the board.
    pub without: ImageSample,
}

/// A few images, spread over all that were offered.
#[derive(Default)]
pub struct ImageSample {
    pub images: Vec<GrayImage>,
    offered: u64,
    /// Every n-th is kept; 0 before the first.
    every: u64,
}

impl ImageSample {
    /// More show no more, and take memory and time.
    const MAX_IMAGES: usize = 8;

    fn offer(&mut self, image: GrayImage) {
        self.every = self.every.max(1);
        if self.offered.is_multiple_of(self.every) {
            if self.images.len() == Self::MAX_IMAGES {
                let mut at = 0..;
                self.images.retain(|_| at.next().is_some_and(|at: usize| at.is_multiple_of(2)));
                self.every *= 2;
            }
            if self.offered.is_multiple_of(self.every) {
                self.images.push(image);
            }
        }
        self.offered += 1;
    }
}

impl BoardSearch {
    /// Warns where most frames do not show the board, but another one.
    pub fn warn_of_another_board(&mut self, board: &Board) {
        let BoardDetections { looked_at, with_board, .. } = self.found;
        if 2 * with_board >= looked_at {
            return;
        }
        let images = &self.without.images;
        if let Some(instead) = seen_instead(board, images).filter(|seen| 2 * seen.images > images.len()) {
            self.warnings.push(format!(
                "{board} was found in {with_board} of {looked_at} frames only; of the others, {instead}: if that is \
                 the board, state it"
            ));
        }
    }

    /// Drops names and thumbnails of sightings that cannot be chosen any more: a recording shows
    /// the board in thousands of frames.
    fn forget_what_cannot_be_chosen(&mut self) {
        const MAX_REMEMBERED: usize = 4096;
        if self.names.len() > MAX_REMEMBERED {
            let mut numbers: BTreeSet<u64> = self.selector.numbers().collect();
            numbers.extend(self.pictures.iter().map(|sighting| sighting.number));
            self.names.retain(|number, _| numbers.contains(number));
            self.thumbnails.retain(|number, _| numbers.contains(number));
        }
    }
}

/// The result for one frame.
pub struct FrameSearch {
    name: String,
    time_s: Option<f64>,
    picture: bool,
    /// The board and how blurred it is, or why it was not found.
    outcome: std::result::Result<(BoardView, Option<f64>), NotFound>,
    /// The image, small, if the board was found; otherwise the image.
    thumbnail: Option<Thumbnail>,
    without: Option<GrayImage>,
}

impl FrameSearch {
    /// The board, or why it was not found.
    pub fn view(&self) -> std::result::Result<&BoardView, &NotFound> {
        self.outcome.as_ref().map(|(view, _)| view)
    }
}

/// Number of images without the board that are named.
const MAX_NAMED: usize = 100;
/// Number of different reasons that are counted: there could be as many board sizes as frames.
const MAX_REASONS: usize = 8;
/// Frames searched, and what was found.
const COUNTED: [&str; 2] = ["{bar:12} {pos}/{len} frames{wide_msg}", "{pos} frames{wide_msg}"];

/// Looks for the board in every frame.
pub fn search(
    input: &mut Input,
    board: &Board,
    selection: SelectionConfig,
    threads: Option<u16>,
    quiet: bool,
) -> Result<BoardSearch> {
    let finder = BoardFinder::new(board);
    let mut gathering = Gathering {
        photographs: input.frame_count.is_some_and(|count| count <= selection.most_views as u64),
        progress: console::progress_as(COUNTED, input.frame_count, quiet),
        ..Gathering::new(board, selection, input.kind())
    };
    let available = || thread::available_parallelism().map_or(1, usize::from);
    let outcome = match threads.map_or_else(available, usize::from) {
        1 => one_by_one(input, &finder, &mut gathering),
        threads => side_by_side(input, &finder, &mut gathering, threads),
    };
    gathering.progress.finish_and_clear();
    let mut search = gathering.finished();
    search.warnings = input.take_warnings();
    outcome.map(|()| search)
}

fn one_by_one(input: &mut Input, finder: &BoardFinder, gathering: &mut Gathering) -> Result<()> {
    while let Some(frame) = next(input)? {
        gathering.add(look(finder, frame));
    }
    Ok(())
}

fn side_by_side(
    input: &mut Input,
    finder: &BoardFinder,
    gathering: &mut Gathering,
    threads: usize,
) -> Result<()> {
    thread::scope(|scope| -> Result<()> {
        let (frames_in, frames_out) = mpsc::sync_channel::<SearchedImage>(threads);
        let (looked_in, looked_out) = mpsc::sync_channel::<(u64, FrameSearch)>(threads);
        let decoder = scope.spawn(move || -> Result<()> {
            while let Some(frame) = next(input)? {
                if frames_in.send(frame).is_err() {
                    break; // the finders have ended
                }
            }
            Ok(())
        });
        let frames_out = Arc::new(Mutex::new(frames_out));
        for _ in 0..threads {
            let (frames_out, looked_in) = (Arc::clone(&frames_out), looked_in.clone());
            scope.spawn(move || {
                loop {
                    let frame = frames_out.lock().ok().and_then(|queue| queue.recv().ok());
                    let Some(frame) = frame else { return };
                    let number = frame.number;
                    if looked_in.send((number, look(finder, frame))).is_err() {
                        return;
                    }
                }
            });
        }
        // Only the threads hold the queues now: they go when the threads do.
        drop((frames_out, looked_in));
        let mut waiting = BTreeMap::new();
        let mut next = 0;
        for (number, looked) in looked_out {
            waiting.insert(number, looked);
            while let Some(looked) = waiting.remove(&next) {
                gathering.add(looked);
                next += 1;
            }
        }
        let died = |_| Error::input("the decoder ended unexpectedly; please report this recording");
        decoder.join().map_err(died)?
    })
}

fn next(input: &mut Input) -> Result<Option<SearchedImage>> {
    if interrupt::asked() { Ok(None) } else { input.next() }
}

/// Looks for the board in a frame.
pub fn look(finder: &BoardFinder, frame: SearchedImage) -> FrameSearch {
    let outcome = finder.find(&frame.image).map(|view| {
        let blur_px = blur_px(&frame.image, &view);
        (view, blur_px)
    });
    let thumbnail = outcome.as_ref().ok().and_then(|_| Thumbnail::new(&frame.image));
    let without = outcome.is_err().then_some(frame.image);
    FrameSearch {
        name: frame.name,
        time_s: frame.time_s,
        picture: frame.picture,
        outcome,
        thumbnail,
        without,
    }
}

/// What has been found so far, frame by frame in their order.
pub struct Gathering {
    search: BoardSearch,
    most_views: usize,
    /// Whether the images were taken one by one, so that their times carry no information about the
    /// motion of the board.
    photographs: bool,
    /// The first of each kind, and its count.
    reasons: Vec<(NotFound, u64)>,
    only_pictures: bool,
    progress: ProgressBar,
}

impl Gathering {
    /// Nothing so far, of a kind of recording that is named; silent.
    pub fn new(board: &Board, selection: SelectionConfig, kind: String) -> Self {
        Self {
            search: BoardSearch {
                found: BoardDetections::default(),
                selector: ViewSelector::new(board, selection),
                pictures: Vec::new(),
                names: BTreeMap::new(),
                thumbnails: BTreeMap::new(),
                warnings: Vec::new(),
                kind,
                without: ImageSample::default(),
            },
            most_views: selection.most_views,
            photographs: false,
            reasons: Vec::new(),
            only_pictures: true,
            progress: ProgressBar::hidden(),
        }
    }

    /// How many frames were looked at, and in how many of them the board was.
    pub fn counts(&self) -> (u64, u64) {
        (self.search.found.looked_at, self.search.found.with_board)
    }

    /// What chooses among the sightings.
    pub fn selector(&self) -> &ViewSelector {
        &self.search.selector
    }

    /// Takes a frame that was looked at, in the order of their numbers.
    pub fn add(&mut self, looked: FrameSearch) {
        let search = &mut self.search;
        let number = search.found.looked_at;
        search.found.looked_at += 1;
        self.only_pictures &= looked.picture;
        self.progress.inc(1);
        match looked.outcome {
            Ok((view, blur_px)) => {
                search.found.with_board += 1;
                let time_s = looked.time_s.filter(|_| !(self.photographs && looked.picture));
                let sighting = Sighting { number, time_s, view, blur_px };
                search.names.insert(number, looked.name);
                if let Some(thumbnail) = looked.thumbnail {
                    search.thumbnails.insert(number, thumbnail);
                }
                // One more than can be used, to detect that there are too many.
                if looked.picture && search.pictures.len() <= self.most_views {
                    search.pictures.push(sighting.clone());
                }
                search.selector.add(sighting);
                search.forget_what_cannot_be_chosen();
                self.say_what_is_missing();
            }
            Err(why) => {
                if let Some(image) = looked.without {
                    search.without.offer(image);
                }
                if looked.picture && search.found.pictures_without.len() < MAX_NAMED {
                    search.found.pictures_without.push((looked.name, why.to_string()));
                }
                match self.reasons.iter().position(|(reason, _)| alike(reason, &why)) {
                    Some(at) => self.reasons[at].1 += 1,
                    None if self.reasons.len() < MAX_REASONS => self.reasons.push((why, 1)),
                    None => {}
                }
            }
        }
    }

    /// Guides the person in front of the camera, if there is a terminal.
    fn say_what_is_missing(&self) {
        // Guidance costs about as much as a frame.
        const EVERY: usize = 10;
        let selector = &self.search.selector;
        if self.progress.is_hidden() || !selector.sightings().is_multiple_of(EVERY) {
            return;
        }
        let guidance = selector.guidance();
        let hints = guidance.missing.iter().take(2).map(|hint| format!(" · {hint}"));
        self.progress.set_message(format!(
            ", board in {}, {} chosen{}",
            self.search.found.with_board,
            guidance.views,
            hints.collect::<String>()
        ));
    }

    /// What was found in all of them.
    pub fn finished(mut self) -> BoardSearch {
        // The most frequent first; of equals the first.
        self.reasons.sort_by_key(|(_, count)| std::cmp::Reverse(*count));
        self.search.found.reasons =
            self.reasons.into_iter().map(|(why, count)| (why.to_string(), count)).collect();
        if !self.only_pictures {
            self.search.pictures.clear();
        }
        self.search
    }
}

/// Whether two reasons are the same to a person. Boards of other sizes count as one.
fn alike(one: &NotFound, other: &NotFound) -> bool {
    match one {
        NotFound::OtherSize { .. } => one == other,
        _ => std::mem::discriminant(one) == std::mem::discriminant(other),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sample_is_small_and_spread_over_all_images() {
        let mut sample = ImageSample::default();
        for number in 0..100u8 {
            let image = GrayImage::from_samples(1, 1, vec![number]);
            sample.offer(image.unwrap_or_else(|| panic!("one pixel")));
            assert!(sample.images.len() <= ImageSample::MAX_IMAGES);
        }
        let numbers: Vec<u8> = sample.images.iter().map(|image| image.samples()[0]).collect();
        assert_eq!(numbers, [0, 16, 32, 48, 64, 80, 96]);
    }
}
