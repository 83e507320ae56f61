//! Why a run was not recognised in a map: whether its ground is that of the map at another height
//! of the camera. One of the two heights is wrong then.

use odograph::geometry::GroundPose;
use odograph::ground_map::KeyframeImages;
use odograph::image::Pyramid;
use odograph::place_recognition::{PlaceIndex, PlacesConfig, Signature};
use odograph::slam::Mapper;
use std::fmt;
use std::sync::Arc;

/// Number of keyframes that are looked up, spread over the run: more take longer.
const MAX_LOOKED_UP: usize = 4;
/// Ratio between neighbouring heights that are tried, and their number to either side: signatures
/// are recognised at heights that are off by some per cent, and larger factors than three are too
/// coarse for the signatures of the map.
const STEP: f64 = 1.09;
const STEPS: i32 = 13;
/// Heights within this ratio would have been recognised: the ratio is no reason.
const SAME: f64 = 1.04;
/// Keyframes must agree on the height to within this ratio.
const AGREEING: f64 = 1.05;
/// Levels of a keyframe's pyramid, down to pixels of a spot of a map from three times the height.
const LEVELS: usize = 6;

/// The height at which the ground of a run resembles that of a map.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OtherScale {
    /// The height of the camera by which the run was tracked, metres.
    pub height_m: f64,
    /// The height at which its ground would be that of the map, metres.
    pub in_map_m: f64,
}

impl OtherScale {
    /// Looks for another height with the keyframes of a run that was not recognised; it was tracked
    /// with `height_m`.
    pub(crate) fn of(mapper: &Mapper, height_m: f64, images: &mut dyn KeyframeImages) -> Option<Self> {
        let (map, session) = (mapper.map(), mapper.session());
        let config = PlacesConfig::new(&map.camera, map.rig.first_pose().height_m);
        let mut index = PlaceIndex::new(&config);
        for keyframe in map.keyframes.iter().filter(|keyframe| keyframe.session != session) {
            index.insert(keyframe.id, &keyframe.signature);
        }
        if index.is_empty() {
            return None;
        }
        let (camera, mask) = (map.camera_of(session), map.masks.get(&session).map(Arc::as_ref));
        let own: Vec<_> = map.keyframes.iter().filter(|keyframe| keyframe.session == session).collect();
        let every = own.len().div_ceil(MAX_LOOKED_UP).max(1);
        let mut found: Vec<f64> = Vec::new();
        for keyframe in own.iter().step_by(every) {
            let Ok(image) = images.load(keyframe.id) else { continue };
            let pyramid = Pyramid::new(image.gray, LEVELS);
            let at = |step: i32| {
                let ratio = STEP.powi(step);
                let higher = GroundPose { height_m: keyframe.pose.height_m * ratio, ..keyframe.pose };
                let best = index.query(&Signature::of(&pyramid, camera, mask, &higher, &config), 1);
                let best = best.into_iter().find(|place| place.is_sure())?;
                Some((best.score, ratio * best.motion.w.exp()))
            };
            let best = (-STEPS..=STEPS).filter_map(at).max_by(|a, b| a.0.total_cmp(&b.0));
            found.extend(best.map(|(_, ratio)| ratio));
        }
        // Foreign ground may resemble the map once, at some height.
        let agree = |ratio: f64| found.iter().filter(|other| agrees(ratio, **other, AGREEING)).count();
        let ratio = found.iter().copied().max_by_key(|ratio| agree(*ratio))?;
        let is_certain = agree(ratio) >= own.len().min(2) && !agrees(ratio, 1.0, SAME);
        is_certain.then_some(Self { height_m, in_map_m: height_m * ratio })
    }
}

impl fmt::Display for OtherScale {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { height_m, in_map_m } = self;
        // Two digits of the smaller one: a microscope is millimetres high.
        let decimals = (1.0 - height_m.min(*in_map_m).log10().floor()).clamp(2.0, 9.0) as usize;
        write!(
            f,
            "its ground is found there if the camera was {in_map_m:.decimals$} m above it, not {height_m:.decimals$} m: \
             check the height, here or of the map"
        )
    }
}

/// Whether two ratios are equal to within another one.
fn agrees(ratio: f64, other: f64, within: f64) -> bool {
    (ratio / other).max(other / ratio) <= within
}
