//! Similar places of a map for a recording that was not localized.

use crate::other_scale::OtherScale;
use odograph::geometry::wrap_angle;
use odograph::ground_map::MapKeyframe;
use odograph::keyframe::KeyframeId;
use odograph::keyframe::relative_pose::compose;
use odograph::place_recognition::{PlaceHypothesis, PlaceIndex, PlacesConfig};
use odograph::slam::Mapper;
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::Path;

/// Places of the map that one keyframe of the recording resembles, and the conclusion.
#[derive(Debug, Clone, PartialEq)]
pub struct Resemblance {
    /// Why it was not recognised.
    pub verdict: ResemblanceVerdict,
    /// The places with evidence for them, best first.
    pub places: Vec<AlikePlace>,
    /// The height at which it would have been recognised.
    pub other_scale: Option<OtherScale>,
}

/// Why a recording was not recognised.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ResemblanceVerdict {
    /// No place of the map looks more like it than foreign ground does by chance.
    NeverSeen,
    /// Unknown: it shows too few features to be recognised anywhere.
    TooFewFeatures,
    /// Unknown: what it shows repeats itself, such as equal tiles.
    Repeats,
    /// Unknown: one or more places look like it, but no place is certain.
    Ambiguous,
}

impl ResemblanceVerdict {
    /// Name in JSON.
    pub fn name(self) -> &'static str {
        match self {
            Self::NeverSeen => "never-seen",
            Self::TooFewFeatures => "too-few-features",
            Self::Repeats => "repeats",
            Self::Ambiguous => "ambiguous",
        }
    }

    /// Why nothing was found, for people. `alike` is the number of similar places.
    pub fn sentence(self, source: &str, map: &Path, alike: usize) -> String {
        let map = map.display();
        match self {
            Self::NeverSeen => {
                format!(
                    "not found: {source} resembles nothing in {map}; this ground was probably never mapped, or the \
                     camera has another height or tilt than there (--rig)"
                )
            }
            Self::TooFewFeatures => format!(
                "cannot tell: {source} shows too little texture to be recognised in {map}; it may be blurred or dark"
            ),
            Self::Repeats => format!(
                "cannot tell: what {source} shows repeats itself, and looks alike in many places of {map}"
            ),
            Self::Ambiguous if alike == 1 => {
                format!("cannot tell: {source} looks like one place of {map}, but that is not certain")
            }
            Self::Ambiguous => {
                format!(
                    "cannot tell: {source} looks like {alike} places of {map}, and none of them is certain"
                )
            }
        }
    }
}

/// A place of the map that resembles the recording.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct AlikePlace {
    /// Probability of this place, if it is one of those listed.
    pub probability: f64,
    /// Position along x of the map, metres.
    pub x_m: f64,
    /// Position along y, metres.
    pub y_m: f64,
    /// Counter-clockwise from x of the map.
    pub heading_deg: f64,
    /// The similar keyframe.
    pub keyframe: u64,
    /// The session that it is of.
    pub session: u32,
    /// Matched features weighted by distinctiveness, minus those of the best other pose over the
    /// same keyframe.
    pub evidence: f64,
    /// Matched features.
    pub matches: usize,
    /// Features on the common ground of both images.
    pub shared: usize,
}

/// Minimum number of features of a picture for a verdict on whether its ground was mapped: fewer
/// let poor pictures be judged, more leave them without a verdict.
const MIN_FEATURES: usize = 40;

/// With less evidence no place is listed: pictures of ground outside the map had at most 2.5 (49
/// pictures, six textures), pictures of mapped ground that were not recognised at least 10 (64).
const MIN_EVIDENCE: f64 = 5.0;

/// Logarithm of the odds for each unit of evidence. Evidence also grows with the overlap with the
/// nearest keyframe, which proves nothing where ground repeats exactly; this value fits 155
/// pictures best (53 of the demo, 102 over a photograph repeated every 0.5 or 0.7 m). In all of
/// them the true place is listed.
const LOG_ODDS_PER_EVIDENCE: f64 = 0.05;

/// Ground is called repetitive if at least this number of features, and this share of those in
/// view, have a match elsewhere that is no evidence for a place. Lower values warn of more floors,
/// and of some that do not repeat.
const REPEATED_FEATURES: usize = 20;
const REPEATED_SHARE: f64 = 0.15;

/// Number of keyframes of the recording that are looked up, spread over it: more find more similar
/// places and take longer.
const MAX_LOOKED_UP: usize = 16;

/// Number of similar places that are reported: a list for people.
const MAX_HYPOTHESES: usize = 8;

/// Hypotheses closer than this fraction of the camera's height, and with headings closer than this
/// angle, are one place: larger merges neighbouring places, smaller lists one place twice.
const SAME_PLACE_HEIGHTS: f64 = 0.25;
const SAME_HEADING_RAD: f64 = 0.3;

impl Resemblance {
    /// Compares this run's keyframes with those of the map; the most similar one counts. `None`
    /// without a keyframe.
    pub(crate) fn of(mapper: &Mapper, other_scale: Option<OtherScale>) -> Option<Self> {
        let map = mapper.map();
        let is_new = |keyframe: &&MapKeyframe| keyframe.session == mapper.session();
        let config = PlacesConfig::new(&map.camera, map.rig.first_pose().height_m);
        let mut index = PlaceIndex::new(&config);
        let mut old = BTreeMap::new();
        for keyframe in map.keyframes.iter().filter(|keyframe| !is_new(keyframe)) {
            index.insert(keyframe.id, &keyframe.signature);
            old.insert(keyframe.id, keyframe);
        }
        let new: Vec<_> = map.keyframes.iter().filter(is_new).collect();
        let every = new.len().div_ceil(MAX_LOOKED_UP).max(1);
        let looked_up = new.into_iter().step_by(every).map(|keyframe| {
            let hypotheses = index.query(&keyframe.signature, MAX_HYPOTHESES);
            (keyframe.signature.features.len(), hypotheses)
        });
        let most = |hypotheses: &[PlaceHypothesis]| {
            hypotheses.iter().map(evidence_of).fold(f64::NEG_INFINITY, f64::max)
        };
        let (features, hypotheses) =
            looked_up.max_by(|a, b| most(&a.1).total_cmp(&most(&b.1)).then(a.0.cmp(&b.0)))?;
        let places = places(&hypotheses, &old);
        let repeats = |one: &PlaceHypothesis| {
            one.matches >= REPEATED_FEATURES && one.matches as f64 >= REPEATED_SHARE * one.shared as f64
        };
        let verdict = match places.first() {
            Some(_) => ResemblanceVerdict::Ambiguous,
            None if hypotheses.iter().any(repeats) => ResemblanceVerdict::Repeats,
            None if features < MIN_FEATURES => ResemblanceVerdict::TooFewFeatures,
            None => ResemblanceVerdict::NeverSeen,
        };
        Some(Self { verdict, places, other_scale })
    }
}

fn evidence_of(hypothesis: &PlaceHypothesis) -> f64 {
    hypothesis.worth - hypothesis.rival_worth
}

/// The distinct places of the hypotheses with enough evidence.
fn places(hypotheses: &[PlaceHypothesis], keyframes: &BTreeMap<KeyframeId, &MapKeyframe>) -> Vec<AlikePlace> {
    let mut places: Vec<AlikePlace> = Vec::new();
    let mut evident: Vec<_> = hypotheses.iter().filter(|one| evidence_of(one) >= MIN_EVIDENCE).collect();
    evident.sort_by(|a, b| evidence_of(b).total_cmp(&evidence_of(a)));
    for hypothesis in evident {
        let Some(keyframe) = keyframes.get(&hypothesis.keyframe) else { continue };
        let pose = compose(&keyframe.pose, &hypothesis.motion, 1.0);
        let place = AlikePlace {
            probability: 1.0,
            x_m: pose.x_m,
            y_m: pose.y_m,
            heading_deg: wrap_angle(pose.heading_rad).to_degrees(),
            keyframe: hypothesis.keyframe.0,
            session: keyframe.session,
            evidence: evidence_of(hypothesis),
            matches: hypothesis.matches,
            shared: hypothesis.shared,
        };
        let is_same = |other: &AlikePlace| {
            let turned = wrap_angle((other.heading_deg - place.heading_deg).to_radians()).abs();
            (other.x_m - place.x_m).hypot(other.y_m - place.y_m) < SAME_PLACE_HEIGHTS * pose.height_m
                && turned < SAME_HEADING_RAD
        };
        if !places.iter().any(is_same) {
            places.push(place);
        }
    }
    let best = places.first().map_or(0.0, |place| place.evidence);
    let odds = |place: &AlikePlace| (LOG_ODDS_PER_EVIDENCE * (place.evidence - best)).exp();
    let all: f64 = places.iter().map(odds).sum();
    places.iter_mut().for_each(|place| place.probability = odds(place) / all);
    places
}
