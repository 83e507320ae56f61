//! Verification of a motion between two images of the ground by counting matched features.

use super::features::Features;
use super::lookup::difference;
use crate::image::simd::differing_bits;
use std::f32::consts::{PI, TAU};

/// Maximum Hamming distance of matching descriptors, of 256 bits. Unrelated ones differ in 128 on
/// average; at 76 and with an earlier pattern of comparisons, each of 264 features of asphalt
/// resembled some 35 of its own image.
pub(super) const MAX_DIFFERENCE: u32 = 60;

/// Maximum difference of the orientations of matched features, radians: larger tolerates noisier
/// directions, smaller excludes more chance matches.
const DIRECTION_TOLERANCE: f32 = 0.45;

/// Minimum distance of a pair of features, spots: an error of 1 spot turns a shorter pair by more
/// than 6°.
const SHORTEST_BASELINE: f32 = 10.0;

/// A similarity transform `p ↦ t + s R(θ) p` from the query's ground to the keyframe's, in spots.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Placing {
    pub shift: [f32; 2],
    pub heading_rad: f32,
    pub scale: f32,
}

/// A pair of similar features of the query and of the keyframe.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct FeatureMatch {
    pub query: usize,
    pub keyframe: usize,
    pub difference: u32,
    /// Position of the keyframe's feature, and its rotation relative to the query's: copied, since
    /// the keyframe's data are far away in memory.
    pub there: [f32; 2],
    pub turn_rad: f32,
}

impl FeatureMatch {
    pub fn new(query: (&Features, usize), keyframe: (&Features, usize), difference: u32) -> Self {
        let turn_rad = keyframe.0.directions_rad[keyframe.1] - query.0.directions_rad[query.1];
        let there = keyframe.0.positions[keyframe.1];
        Self { query: query.1, keyframe: keyframe.1, difference, there, turn_rad }
    }
}

/// The angle wrapped to (−π, π]. Angles here are a few turns at most, so truncation finds the
/// number of turns without a library call.
#[inline]
fn turned(angle: f32) -> f32 {
    let turns = angle * (1.0 / TAU);
    angle - TAU * (turns + 0.5f32.copysign(turns)) as i32 as f32
}

impl Placing {
    /// Fewest matches from which the scale is fitted: with fewer it would follow their errors.
    const ENOUGH_FOR_SCALE: usize = 6;

    pub fn apply(&self, place: [f32; 2]) -> [f32; 2] {
        self.applied()(place)
    }

    /// [`Placing::apply`], for many places.
    fn applied(&self) -> impl Fn([f32; 2]) -> [f32; 2] + use<> {
        let (sin, cos) = self.heading_rad.sin_cos();
        let (sin, cos) = (self.scale * sin, self.scale * cos);
        let shift = self.shift;
        move |[x, y]| [shift[0] + cos * x - sin * y, shift[1] + sin * x + cos * y]
    }

    fn inverse(&self) -> Self {
        let (heading_rad, scale) = (-self.heading_rad, 1.0 / self.scale);
        let back = Self { shift: [0.0; 2], heading_rad, scale };
        let [x, y] = back.apply(self.shift);
        Self { shift: [-x, -y], ..back }
    }

    /// From two matches, with scale 1. `None` if their distances or orientations are inconsistent.
    fn from_pair(query: &Features, a: FeatureMatch, b: FeatureMatch) -> Option<Self> {
        let baseline = |p: [f32; 2], q: [f32; 2]| [q[0] - p[0], q[1] - p[1]];
        let in_query = baseline(query.positions[a.query], query.positions[b.query]);
        let in_keyframe = baseline(a.there, b.there);
        let lengths = [in_query, in_keyframe].map(|v| v[0].hypot(v[1]));
        let longer = lengths[0].max(lengths[1]);
        let shorter = lengths[0].min(lengths[1]);
        if shorter < SHORTEST_BASELINE || longer - shorter > 3.0 + 0.08 * longer {
            return None;
        }
        let angle = |v: [f32; 2]| v[1].atan2(v[0]);
        let heading_rad = turned(angle(in_keyframe) - angle(in_query));
        let agrees = |m: FeatureMatch| turned(m.turn_rad - heading_rad).abs() < DIRECTION_TOLERANCE;
        if !agrees(a) || !agrees(b) {
            return None;
        }
        let turn = Self { shift: [0.0; 2], heading_rad, scale: 1.0 };
        let (qa, qb) = (turn.apply(query.positions[a.query]), turn.apply(query.positions[b.query]));
        let (ka, kb) = (a.there, b.there);
        let shift = std::array::from_fn(|k| 0.5 * (ka[k] + kb[k] - qa[k] - qb[k]));
        Some(Self { shift, ..turn })
    }

    /// The least-squares transform of matched features (S. Umeyama, "Least-squares estimation of
    /// transformation parameters between two point patterns", 1991; in the plane a division of
    /// complex numbers). With fewer than [`Placing::ENOUGH_FOR_SCALE`] the scale is fixed at 1.
    fn fitted(query: &Features, matches: &[FeatureMatch]) -> Option<Self> {
        let count = matches.len() as f64;
        if matches.len() < 2 {
            return None;
        }
        let pairs = || matches.iter().map(|m| (query.positions[m.query], m.there));
        let mut means = [0.0f64; 4];
        for (q, k) in pairs() {
            [q[0], q[1], k[0], k[1]]
                .iter()
                .zip(&mut means)
                .for_each(|(&v, mean)| *mean += f64::from(v) / count);
        }
        let (mut along, mut across, mut spread) = (0.0, 0.0, 0.0);
        for (q, k) in pairs() {
            let (qx, qy) = (f64::from(q[0]) - means[0], f64::from(q[1]) - means[1]);
            let (kx, ky) = (f64::from(k[0]) - means[2], f64::from(k[1]) - means[3]);
            along += qx * kx + qy * ky;
            across += qx * ky - qy * kx;
            spread += qx * qx + qy * qy;
        }
        if spread < 1.0 {
            return None;
        }
        let scale = if matches.len() < Self::ENOUGH_FOR_SCALE { 1.0 } else { along.hypot(across) / spread };
        let heading = across.atan2(along);
        let (sin, cos) = (scale * heading.sin(), scale * heading.cos());
        let shift = [means[2] - cos * means[0] + sin * means[1], means[3] - sin * means[0] - cos * means[1]];
        Some(Self { shift: shift.map(|v| v as f32), heading_rad: heading as f32, scale: scale as f32 })
    }

    /// Whether two transforms put the query's centre at different positions or headings.
    pub fn differs(&self, other: &Self, middle: [f32; 2]) -> bool {
        let (a, b) = (self.apply(middle), other.apply(middle));
        (a[0] - b[0]).hypot(a[1] - b[1]) > 12.0 || turned(self.heading_rad - other.heading_rad).abs() > 0.15
    }
}

/// A placing with its support.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Support {
    pub placing: Placing,
    /// Number of matches.
    pub matches: usize,
    /// Sum of their weights.
    pub worth: f32,
    /// Number of features in the overlap, of the image with fewer of them.
    pub shared: usize,
    /// Standard deviation of the logarithm of the scale; infinite where the scale is fixed at 1.
    pub ln_scale_deviation: f32,
}

/// The transform, among those of pairs of matches, with the most votes, and their number.
pub(super) fn best_pair(query: &Features, matches: &[FeatureMatch]) -> Option<(Placing, usize)> {
    /// Pairs are made of this number of the most similar matches: time grows with its square.
    const MAX_PAIRED: usize = 14;
    /// Largest distance of a match that agrees with a pair, spots along each axis.
    const NEAR: f32 = 6.0;
    let mut best: Option<(Placing, usize)> = None;
    let paired = &matches[..matches.len().min(MAX_PAIRED)];
    for (i, &a) in paired.iter().enumerate() {
        for &b in &paired[..i] {
            let Some(placing) = Placing::from_pair(query, a, b) else { continue };
            let applied = placing.applied();
            let agreeing = matches.iter().filter(|m| {
                let (at, there) = (applied(query.positions[m.query]), m.there);
                (at[0] - there[0]).abs().max((at[1] - there[1]).abs()) < NEAR
            });
            let count = agreeing.count();
            if best.is_none_or(|(_, most)| count > most) {
                best = Some((placing, count));
            }
        }
    }
    best
}

/// Minimum number of matches for a refinement: two determine the transform, a third confirms it.
const MIN_TO_GO_ON: usize = 3;

/// Searches every feature of the query in the keyframe under a transform, fits, and searches again
/// with a smaller radius.
pub(super) fn support(query: &Features, keyframe: &Features, start: Placing) -> Option<Support> {
    let mut placing = start;
    let mut matches = Vec::new();
    for radius in [6.0, 4.0, 3.0] {
        find_matches(query, keyframe, &placing, radius, &mut matches);
        if matches.len() < MIN_TO_GO_ON {
            return None;
        }
        placing = Placing::fitted(query, &matches)?;
        if !(0.7..1.4).contains(&placing.scale) {
            return None;
        }
    }
    find_matches(query, keyframe, &placing, 2.5, &mut matches);
    let (onto, back) = (placing.applied(), placing.inverse().applied());
    let square_distance = |m: &FeatureMatch| {
        let (at, there) = (onto(query.positions[m.query]), m.there);
        (at[0] - there[0]).powi(2) + (at[1] - there[1]).powi(2)
    };
    let squares: f32 = matches.iter().map(square_distance).sum();
    let ln_scale_deviation = ln_scale_deviation(query, &matches, placing.scale, squares);
    let there = query.positions.iter().filter(|&&place| keyframe.covers(onto(place))).count();
    let here = keyframe.positions.iter().filter(|&&place| query.covers(back(place))).count();
    Some(Support {
        placing,
        matches: matches.len(),
        worth: matches.iter().map(|m| query.worth[m.query].min(keyframe.worth[m.keyframe])).sum(),
        shared: here.min(there).max(matches.len()),
        ln_scale_deviation,
    })
}

/// Standard deviation of the logarithm of a fitted scale. `squares` is the sum of the squared
/// distances of the matches, spots². The fit has four parameters for their `2 n` coordinates; a
/// relative error of the scale moves each feature in proportion to its distance from their mean.
fn ln_scale_deviation(query: &Features, matches: &[FeatureMatch], scale: f32, squares: f32) -> f32 {
    if matches.len() < Placing::ENOUGH_FOR_SCALE {
        return f32::INFINITY;
    }
    let count = matches.len() as f32;
    let places = || matches.iter().map(|m| query.positions[m.query]);
    let middle: [f32; 2] = std::array::from_fn(|k| places().map(|place| place[k]).sum::<f32>() / count);
    let spread: f32 =
        places().map(|place| (place[0] - middle[0]).powi(2) + (place[1] - middle[1]).powi(2)).sum();
    (squares / (2.0 * count - 4.0) / spread.max(f32::MIN_POSITIVE)).sqrt() / scale
}

/// For every feature of the query the most similar one within `radius` spots; each of the
/// keyframe's is assigned once, to the most similar.
fn find_matches(
    query: &Features,
    keyframe: &Features,
    placing: &Placing,
    radius: f32,
    matches: &mut Vec<FeatureMatch>,
) {
    matches.clear();
    let applied = placing.applied();
    for (number, &position) in query.positions.iter().enumerate() {
        let at = applied(position);
        if !keyframe.covers(at) {
            continue;
        }
        let direction_rad = query.directions_rad[number] + placing.heading_rad;
        let mut best: Option<FeatureMatch> = None;
        for candidate in keyframe.around(at, radius) {
            let there = keyframe.positions[candidate];
            let off = [there[0] - at[0], there[1] - at[1]];
            if off[0] * off[0] + off[1] * off[1] > radius * radius
                || turned(keyframe.directions_rad[candidate] - direction_rad).abs() > DIRECTION_TOLERANCE
            {
                continue;
            }
            let descriptors = (&query.descriptors[number], &keyframe.descriptors[candidate]);
            let allowed = best.map_or(MAX_DIFFERENCE, |best| best.difference);
            let Some(difference) = difference(descriptors.0, descriptors.1, allowed) else { continue };
            // Ties are decided by index, independent of the order here.
            if best.is_none_or(|best| (difference, candidate) < (best.difference, best.keyframe)) {
                best = Some(FeatureMatch::new((query, number), (keyframe, candidate), difference));
            }
        }
        matches.extend(best);
    }
    matches.sort_unstable_by_key(|m| (m.keyframe, m.difference, m.query));
    matches.dedup_by_key(|m| m.keyframe);
}

/// Number of matches that shows similar ground; unrelated ground has up to five by chance.
const MIN_TO_EXTRAPOLATE: usize = 8;

/// The support of the best other transform of the two images, among those with the most single
/// votes, scaled to an equal overlap. Repetitive patterns have one.
pub(super) fn rival(query: &Features, keyframe: &Features, best: &Support) -> Option<Support> {
    let middle = query.middle();
    // Votes for the transform itself also fall into the neighbouring bins; they must not keep
    // others from being tried.
    let other = |placing: &Placing| placing.differs(&best.placing, middle);
    // Repetitive ground matches itself shifted by a period, with less overlap: what counts is the
    // matched share of the overlap.
    let as_much_ground = |found: Support| {
        let more = best.shared as f32 / found.shared.max(1) as f32;
        let are_enough = found.matches >= MIN_TO_EXTRAPOLATE;
        Support { worth: found.worth * if are_enough { more.max(1.0) } else { 1.0 }, ..found }
    };
    let tried = voted(query, keyframe).into_iter().filter(other).take(MAX_TRIED);
    let found = tried.filter_map(|placing| support(query, keyframe, placing)).filter(|s| other(&s.placing));
    found.map(as_much_ground).max_by(|a, b| a.worth.total_cmp(&b.worth).then(a.matches.cmp(&b.matches)))
}

/// Number of transforms of two images that are tried. Of 24 200 pictures of a floor of one tile
/// repeated, 111 were called certain when votes for the transform itself took up the eight.
const MAX_TRIED: usize = 8;

/// The distinct transforms of the two images with the most single votes, each with its support. On
/// ground that repeats itself these are shifted by its periods.
pub(super) fn supported(query: &Features, keyframe: &Features) -> Vec<Support> {
    let middle = query.middle();
    let mut found: Vec<Support> = Vec::new();
    for placing in voted(query, keyframe).into_iter().take(2 * MAX_TRIED) {
        let Some(support) = support(query, keyframe, placing) else { continue };
        if found.iter().all(|other| other.placing.differs(&support.placing, middle)) {
            found.push(support);
        }
    }
    found
}

/// The transforms with two or more votes of single matches, those with the most first.
fn voted(query: &Features, keyframe: &Features) -> Vec<Placing> {
    let middle = query.middle();
    let mut votes = Vec::new();
    let mut differences = vec![0; keyframe.len()];
    for (number, descriptor) in query.descriptors.iter().enumerate() {
        differing_bits(descriptor, &keyframe.descriptors, &mut differences);
        for (other, _) in differences.iter().enumerate().filter(|(_, bits)| **bits <= MAX_DIFFERENCE) {
            let heading_rad = turned(keyframe.directions_rad[other] - query.directions_rad[number]);
            let turn = Placing { shift: [0.0; 2], heading_rad, scale: 1.0 };
            let off = turn.apply(std::array::from_fn(|k| middle[k] - query.positions[number][k]));
            let middle: [f32; 2] = std::array::from_fn(|k| keyframe.positions[other][k] + off[k]);
            votes.push(Vote { bin: bin(middle, heading_rad), middle, heading_rad });
        }
    }
    votes.sort_unstable_by_key(|vote| vote.bin);
    let groups = votes.chunk_by_mut(|a, b| a.bin == b.bin).filter(|group| group.len() > 1);
    let mut groups: Vec<&mut [Vote]> = groups.collect();
    groups.sort_unstable_by_key(|group| (std::cmp::Reverse(group.len()), group[0].bin));
    let placing = |group: &mut [Vote]| {
        // The sums do not depend on the order of the features.
        group.sort_unstable_by(|a, b| {
            let by_place = a.middle[0].total_cmp(&b.middle[0]).then(a.middle[1].total_cmp(&b.middle[1]));
            by_place.then(a.heading_rad.total_cmp(&b.heading_rad))
        });
        let mean = |value: fn(&Vote) -> f32| group.iter().map(value).sum::<f32>() / group.len() as f32;
        let turn = Placing { shift: [0.0; 2], heading_rad: mean(|vote| vote.heading_rad), scale: 1.0 };
        let [x, y] = turn.apply(middle);
        Placing { shift: [mean(|v| v.middle[0]) - x, mean(|v| v.middle[1]) - y], ..turn }
    };
    groups.into_iter().map(placing).collect()
}

/// The place and direction of the query's centre by a single match.
#[derive(Clone, Copy)]
struct Vote {
    bin: u64,
    middle: [f32; 2],
    heading_rad: f32,
}

/// The bin of a vote, 20 spots and 15° wide. Ordered by x, then y, then heading.
fn bin([x, y]: [f32; 2], heading_rad: f32) -> u64 {
    let bins = [(x / 20.0).floor(), (y / 20.0).floor(), ((heading_rad + PI) / TAU * 24.0).floor()];
    bins.map(|v| u64::from((v as i16 as u16) ^ 0x8000)).into_iter().fold(0, |all, bin| all << 16 | bin)
}
