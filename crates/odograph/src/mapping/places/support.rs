//! What speaks for a motion between two pictures of the ground.

use super::GroundFeature;
use super::lookup::difference;
use std::f32::consts::{PI, TAU};

/// Descriptors that differ in more bits than this do not show the same. Unrelated ones differ in 128 on the average.
pub(super) const MOST_DIFFERENCE: u32 = 60;

/// Descriptors of one picture that differ in no more bits than this could be taken for each other.
const LOOKALIKE_DIFFERENCE: u32 = 40;

/// Directions of the same pattern agree within this, radians.
const DIRECTION_TOLERANCE: f32 = 0.45;

/// Pairs nearer than this many spots say too little about the heading.
const SHORTEST_BASELINE: f32 = 10.0;

/// A shift, a turn and a scale: `p ↦ t + s R(θ) p`, from the query's ground to the keyframe's, in spots.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Placing {
    pub shift: [f32; 2],
    pub heading_rad: f32,
    pub scale: f32,
}

/// A feature of the query and one of the keyframe that look alike.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Match {
    pub query: usize,
    pub keyframe: usize,
    pub difference: u32,
}

/// A picture's features, brought to spots and ordered by x, so that those near a place are found quickly.
#[derive(Debug, Clone, Default)]
pub(super) struct Features {
    pub features: Vec<GroundFeature>,
    /// What a match of each is worth: one over the number of features of the picture that look like it, itself included.
    pub worth: Vec<f32>,
    low: [f32; 2],
    high: [f32; 2],
}

/// The angle brought near zero. Angles here are a few turns at most, so the nearest number of turns is got by cutting off, without a call of a library.
#[inline]
fn turned(angle: f32) -> f32 {
    let turns = angle * (1.0 / TAU);
    angle - TAU * (turns + 0.5f32.copysign(turns)) as i32 as f32
}

impl Features {
    pub fn new(features: &[GroundFeature], spot_m: f64) -> Self {
        let scale = (1.0 / spot_m) as f32;
        let in_spots = |feature: &GroundFeature| GroundFeature {
            position_m: feature.position_m.map(|metres| metres * scale),
            ..*feature
        };
        let mut features: Vec<_> = features.iter().take(super::MOST_FEATURES).map(in_spots).collect();
        features.sort_by(|a, b| {
            let by_place = |k: usize| a.position_m[k].total_cmp(&b.position_m[k]);
            by_place(0).then(by_place(1)).then(a.descriptor.cmp(&b.descriptor))
        });
        let (mut low, mut high) = ([f32::INFINITY; 2], [f32::NEG_INFINITY; 2]);
        for feature in &features {
            for k in 0..2 {
                low[k] = low[k].min(feature.position_m[k]);
                high[k] = high[k].max(feature.position_m[k]);
            }
        }
        let mut alike = vec![1u16; features.len()];
        for (i, a) in features.iter().enumerate() {
            for (j, b) in features.iter().enumerate().take(i) {
                if difference(&a.descriptor, &b.descriptor, LOOKALIKE_DIFFERENCE).is_some() {
                    alike[i] += 1;
                    alike[j] += 1;
                }
            }
        }
        let worth = alike.into_iter().map(|alike| 1.0 / f32::from(alike)).collect();
        Self { features, worth, low, high }
    }

    pub fn position(&self, at: usize) -> [f32; 2] {
        self.features[at].position_m
    }

    fn covers(&self, [x, y]: [f32; 2]) -> bool {
        x >= self.low[0] && x <= self.high[0] && y >= self.low[1] && y <= self.high[1]
    }

    /// The features whose x lies within `radius` of `x`.
    fn around(&self, x: f32, radius: f32) -> std::ops::Range<usize> {
        let first = self.features.partition_point(|feature| feature.position_m[0] < x - radius);
        let rest = &self.features[first..];
        first..first + rest.partition_point(|feature| feature.position_m[0] <= x + radius)
    }
}

impl Placing {
    pub fn apply(&self, [x, y]: [f32; 2]) -> [f32; 2] {
        let (sin, cos) = self.heading_rad.sin_cos();
        let (sin, cos) = (self.scale * sin, self.scale * cos);
        [self.shift[0] + cos * x - sin * y, self.shift[1] + sin * x + cos * y]
    }

    fn inverse(&self) -> Self {
        let (heading_rad, scale) = (-self.heading_rad, 1.0 / self.scale);
        let back = Self { shift: [0.0; 2], heading_rad, scale };
        let [x, y] = back.apply(self.shift);
        Self { shift: [-x, -y], ..back }
    }

    /// From two matches, without a scale. `None` where they contradict each other: other distances, or other turns.
    fn from_pair(query: &Features, keyframe: &Features, a: Match, b: Match) -> Option<Self> {
        let baseline = |p: [f32; 2], q: [f32; 2]| [q[0] - p[0], q[1] - p[1]];
        let in_query = baseline(query.position(a.query), query.position(b.query));
        let in_keyframe = baseline(keyframe.position(a.keyframe), keyframe.position(b.keyframe));
        let lengths = [in_query, in_keyframe].map(|v| v[0].hypot(v[1]));
        let longer = lengths[0].max(lengths[1]);
        let shorter = lengths[0].min(lengths[1]);
        if shorter < SHORTEST_BASELINE || longer - shorter > 3.0 + 0.08 * longer {
            return None;
        }
        let angle = |v: [f32; 2]| v[1].atan2(v[0]);
        let heading_rad = turned(angle(in_keyframe) - angle(in_query));
        let agrees = |m: Match| {
            let turn = keyframe.features[m.keyframe].direction_rad - query.features[m.query].direction_rad;
            turned(turn - heading_rad).abs() < DIRECTION_TOLERANCE
        };
        if !agrees(a) || !agrees(b) {
            return None;
        }
        let turn = Self { shift: [0.0; 2], heading_rad, scale: 1.0 };
        let (qa, qb) = (turn.apply(query.position(a.query)), turn.apply(query.position(b.query)));
        let (ka, kb) = (keyframe.position(a.keyframe), keyframe.position(b.keyframe));
        let shift = std::array::from_fn(|k| 0.5 * (ka[k] + kb[k] - qa[k] - qb[k]));
        Some(Self { shift, ..turn })
    }

    /// The placing that takes matched features to each other with the least sum of squares (S. Umeyama, "Least-squares estimation of
    /// transformation parameters between two point patterns", 1991; in the plane it is a division of complex numbers). From few matches the scale
    /// is not taken: it would follow their errors.
    fn fitted(query: &Features, keyframe: &Features, matches: &[Match]) -> Option<Self> {
        const ENOUGH_FOR_SCALE: usize = 6;
        let count = matches.len() as f64;
        if matches.len() < 2 {
            return None;
        }
        let pairs = || matches.iter().map(|m| (query.position(m.query), keyframe.position(m.keyframe)));
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
        let scale = if matches.len() < ENOUGH_FOR_SCALE { 1.0 } else { along.hypot(across) / spread };
        let heading = across.atan2(along);
        let (sin, cos) = (scale * heading.sin(), scale * heading.cos());
        let shift = [means[2] - cos * means[0] + sin * means[1], means[3] - sin * means[0] - cos * means[1]];
        Some(Self { shift: shift.map(|v| v as f32), heading_rad: heading as f32, scale: scale as f32 })
    }

    /// Whether two placings put the middle of the query at other places or other headings.
    pub fn differs(&self, other: &Self, middle: [f32; 2]) -> bool {
        let (a, b) = (self.apply(middle), other.apply(middle));
        (a[0] - b[0]).hypot(a[1] - b[1]) > 12.0 || turned(self.heading_rad - other.heading_rad).abs() > 0.15
    }
}

/// A placing with what speaks for it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Support {
    pub placing: Placing,
    /// Features of both pictures found in each other's place.
    pub matches: usize,
    /// The sum of what these are worth.
    pub worth: f32,
    /// Features of the picture that shows fewer of them on the ground that both show.
    pub shared: usize,
    /// Root mean square distance of matched features, spots.
    pub residual: f32,
}

/// The placing, of those that pairs of matches give, with which most others agree, and how many do.
pub(super) fn best_pair(
    query: &Features,
    keyframe: &Features,
    matches: &[Match],
) -> Option<(Placing, usize)> {
    /// Pairs are made of the matches that are most alike.
    const MOST_PAIRED: usize = 14;
    const NEAR: f32 = 6.0;
    let mut best: Option<(Placing, usize)> = None;
    let paired = &matches[..matches.len().min(MOST_PAIRED)];
    for (i, &a) in paired.iter().enumerate() {
        for &b in &paired[..i] {
            let Some(placing) = Placing::from_pair(query, keyframe, a, b) else { continue };
            let agreeing = matches.iter().filter(|m| {
                let (at, there) = (placing.apply(query.position(m.query)), keyframe.position(m.keyframe));
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

/// With fewer matches around a placing a better fit will not find many more.
const LEAST_TO_GO_ON: usize = 3;

/// Looks under a placing for every feature of the query in the keyframe, fits, and looks again closer by.
pub(super) fn support(query: &Features, keyframe: &Features, start: Placing) -> Option<Support> {
    let mut placing = start;
    let mut matches = Vec::new();
    for radius in [6.0, 4.0, 3.0] {
        find_matches(query, keyframe, &placing, radius, &mut matches);
        if matches.len() < LEAST_TO_GO_ON {
            return None;
        }
        placing = Placing::fitted(query, keyframe, &matches)?;
        if !(0.7..1.4).contains(&placing.scale) {
            return None;
        }
    }
    find_matches(query, keyframe, &placing, 2.5, &mut matches);
    let squares: f32 = matches.iter().map(|m| square_distance(query, keyframe, &placing, *m)).sum();
    let back = placing.inverse();
    let there = query.features.iter().filter(|f| keyframe.covers(placing.apply(f.position_m))).count();
    let here = keyframe.features.iter().filter(|f| query.covers(back.apply(f.position_m))).count();
    Some(Support {
        placing,
        matches: matches.len(),
        worth: matches.iter().map(|m| query.worth[m.query].min(keyframe.worth[m.keyframe])).sum(),
        shared: here.min(there).max(matches.len()),
        residual: (squares / matches.len().max(1) as f32).sqrt(),
    })
}

fn square_distance(query: &Features, keyframe: &Features, placing: &Placing, m: Match) -> f32 {
    let (at, there) = (placing.apply(query.position(m.query)), keyframe.position(m.keyframe));
    (at[0] - there[0]).powi(2) + (at[1] - there[1]).powi(2)
}

/// For every feature of the query the one within `radius` spots that is most alike; each of the keyframe's is taken once, by the query's that is
/// most like it.
fn find_matches(
    query: &Features,
    keyframe: &Features,
    placing: &Placing,
    radius: f32,
    matches: &mut Vec<Match>,
) {
    matches.clear();
    for (number, feature) in query.features.iter().enumerate() {
        let at = placing.apply(feature.position_m);
        if !keyframe.covers(at) {
            continue;
        }
        let direction = feature.direction_rad + placing.heading_rad;
        let mut best = Match { query: number, keyframe: 0, difference: MOST_DIFFERENCE + 1 };
        for candidate in keyframe.around(at[0], radius) {
            let other = &keyframe.features[candidate];
            let off = [other.position_m[0] - at[0], other.position_m[1] - at[1]];
            if off[0] * off[0] + off[1] * off[1] > radius * radius
                || turned(other.direction_rad - direction).abs() > DIRECTION_TOLERANCE
            {
                continue;
            }
            let allowed = best.difference - 1;
            if let Some(difference) = difference(&feature.descriptor, &other.descriptor, allowed) {
                best = Match { keyframe: candidate, difference, ..best };
                if difference == 0 {
                    break;
                }
            }
        }
        if best.difference <= MOST_DIFFERENCE {
            matches.push(best);
        }
    }
    matches.sort_unstable_by_key(|m| (m.keyframe, m.difference, m.query));
    matches.dedup_by_key(|m| m.keyframe);
}

/// Unrelated ground has up to five matches by chance; so many tell that ground is alike.
const LEAST_TO_EXTRAPOLATE: usize = 8;

/// The support of the best other placing of the two pictures, of those that most single matches vote for; its worth as if they shared as much ground under it as
/// under the best. Where a pattern repeats there is one.
pub(super) fn rival(query: &Features, keyframe: &Features, best: &Support) -> Option<Support> {
    const MOST_TRIED: usize = 8;
    let middle: [f32; 2] = std::array::from_fn(|k| 0.5 * (query.low[k] + query.high[k]));
    let mut votes = Vec::new();
    for feature in &query.features {
        for other in &keyframe.features {
            if difference(&feature.descriptor, &other.descriptor, MOST_DIFFERENCE).is_none() {
                continue;
            }
            let heading_rad = turned(other.direction_rad - feature.direction_rad);
            let turn = Placing { shift: [0.0; 2], heading_rad, scale: 1.0 };
            let off = turn.apply(std::array::from_fn(|k| middle[k] - feature.position_m[k]));
            let middle: [f32; 2] = std::array::from_fn(|k| other.position_m[k] + off[k]);
            votes.push(Vote { bin: bin(middle, heading_rad), middle, heading_rad });
        }
    }
    votes.sort_unstable_by(|a, b| {
        let by_place = a.middle[0].total_cmp(&b.middle[0]).then(a.middle[1].total_cmp(&b.middle[1]));
        a.bin.cmp(&b.bin).then(by_place).then(a.heading_rad.total_cmp(&b.heading_rad))
    });
    let mut groups: Vec<_> = votes.chunk_by(|a, b| a.bin == b.bin).filter(|group| group.len() > 1).collect();
    groups.sort_by_key(|group| (std::cmp::Reverse(group.len()), group[0].bin));
    // Votes for the placing itself fall into the bins around it, too; where they are the most, they must not keep the others from being tried.
    let other = |placing: &Placing| placing.differs(&best.placing, middle);
    let placing = |group: &[Vote]| {
        let mean = |value: fn(&Vote) -> f32| group.iter().map(value).sum::<f32>() / group.len() as f32;
        let turn = Placing { shift: [0.0; 2], heading_rad: mean(|vote| vote.heading_rad), scale: 1.0 };
        let [x, y] = turn.apply(middle);
        Placing { shift: [mean(|v| v.middle[0]) - x, mean(|v| v.middle[1]) - y], ..turn }
    };
    // A floor that repeats shows the same shifted by a tile, only less of it: what counts is how much of the ground that is shared is alike.
    let as_much_ground = |found: Support| {
        let more = best.shared as f32 / found.shared.max(1) as f32;
        let told = found.matches >= LEAST_TO_EXTRAPOLATE;
        Support { worth: found.worth * if told { more.max(1.0) } else { 1.0 }, ..found }
    };
    let tried = groups.into_iter().map(placing).filter(other).take(MOST_TRIED);
    let found = tried.filter_map(|placing| support(query, keyframe, placing)).filter(|s| other(&s.placing));
    found.map(as_much_ground).max_by(|a, b| a.worth.total_cmp(&b.worth).then(a.matches.cmp(&b.matches)))
}

/// Where one match alone would put the middle of the query, and which way.
struct Vote {
    bin: [i16; 3],
    middle: [f32; 2],
    heading_rad: f32,
}

/// The bin of a vote: 20 spots and 15° wide.
fn bin([x, y]: [f32; 2], heading_rad: f32) -> [i16; 3] {
    [(x / 20.0).floor(), (y / 20.0).floor(), ((heading_rad + PI) / TAU * 24.0).floor()].map(|v| v as i16)
}
