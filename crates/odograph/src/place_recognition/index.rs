//! The index: returns hypotheses of the places that signatures show.

use super::features::Features;
use super::lookup::{Buckets, FeatureNumber};
use super::support::{FeatureMatch, MAX_DIFFERENCE, Placing, Support, best_pair, rival, support, supported};
use super::{PlacesConfig, Signature};
use crate::image::simd::differing_bits_of_pairs;
use crate::keyframe::KeyframeId;
use nalgebra::Vector4;
use std::cmp::Reverse;
use std::collections::HashMap;

/// Maximum number of descriptor comparisons per query; the emptiest buckets come first. Bounds the
/// time of a query on repetitive ground, at the cost of recall there.
const MAX_COMPARISONS: u32 = 12_000;

/// Maximum number of keyframes verified per query: more find a place that others resemble, and each
/// takes time.
const MAX_CANDIDATES: usize = 16;

/// The same for lookalikes, which are looked for only in a picture that has no certain place.
const MAX_ALIKE_KEYFRAMES: usize = 64;

/// Once one keyframe has this number of votes, others with less than a fifth of them are not
/// verified: they show other ground, and verifying them takes time.
const MANY_AGREEING: usize = 15;
/// The factor: a keyframe needs one vote for this number of the best.
const FEW_OF_MANY: usize = 5;

/// Minimum number of matches of a hypothesis: unrelated ground has up to five by chance, so weaker
/// hypotheses say nothing.
const MIN_MATCHES: usize = 5;

/// Minimum worth at which the test for ambiguity, the slowest step, is made: a hypothesis below it
/// is never certain.
const WORTH_A_RIVAL: f32 = 3.0;

/// Index of keyframes by the appearance of their ground.
#[derive(Debug, Clone)]
pub struct PlaceIndex {
    spot_m: f64,
    slots: Vec<Slot>,
    slot_of: HashMap<KeyframeId, usize>,
    /// Free slots of removed keyframes.
    free: Vec<usize>,
    buckets: Buckets,
}

#[derive(Debug, Clone, Default)]
struct Slot {
    keyframe: Option<KeyframeId>,
    features: Features,
}

/// The hypothesis that an image shows the ground of a keyframe at a relative pose.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlaceHypothesis {
    /// The keyframe.
    pub keyframe: KeyframeId,
    /// The pose of the query as the keyframe sees it, as in
    /// [`MapEdge::motion`](crate::keyframe::MapEdge::motion): x (up in the keyframe's image) and y
    /// (left) in metres, heading in radians, and the natural logarithm of a scale. The scale is 1
    /// where both signatures were taken at their true heights; otherwise it is the query's true
    /// height over the one its signature was taken with, if the keyframe's is right.
    pub motion: Vector4<f64>,
    /// Standard deviation of the logarithm of the scale, by the matched features; infinite where
    /// they are too few to show a scale, which is then 1.
    pub ln_scale_deviation: f64,
    /// Number of matched features, one to one.
    pub matches: usize,
    /// Number of features in the overlap, of the image with fewer of them.
    pub shared: usize,
    /// Sum of the matches' weights: each one over the number of similar features in its own image,
    /// so repetitive patterns weigh little.
    pub worth: f64,
    /// The same for the best other motion, scaled to an equal overlap.
    pub rival_worth: f64,
    /// Score that orders hypotheses: the worth minus that of the best other motion, in standard
    /// deviations.
    pub score: f64,
}

impl PlaceHypothesis {
    /// Whether the place is certain: enough matches, a high inlier ratio, and far more support than
    /// any other motion.
    pub fn is_sure(&self) -> bool {
        const MIN_WORTH: f64 = 8.0;
        const MIN_SHARE: f64 = 0.15;
        self.worth >= MIN_WORTH
            && self.matches as f64 >= MIN_SHARE * self.shared as f64
            && self.worth >= 2.0 * self.rival_worth
    }
}

impl PlaceIndex {
    /// An empty index for signatures that were taken with this configuration.
    pub fn new(config: &PlacesConfig) -> Self {
        Self {
            spot_m: config.spot_m,
            slots: Vec::new(),
            slot_of: HashMap::new(),
            free: Vec::new(),
            buckets: Buckets::new(),
        }
    }

    /// Number of keyframes.
    pub fn len(&self) -> usize {
        self.slot_of.len()
    }

    /// Whether it is empty.
    pub fn is_empty(&self) -> bool {
        self.slot_of.is_empty()
    }

    /// Inserts or replaces a keyframe. The index holds at most eight million.
    pub fn insert(&mut self, keyframe: KeyframeId, signature: &Signature) {
        self.remove(keyframe);
        let number = self.free.pop().unwrap_or(self.slots.len());
        if number >= FeatureNumber::MAX_SLOTS {
            return;
        }
        let features = Features::new(&signature.features, self.spot_m);
        for (at, descriptor) in features.descriptors.iter().enumerate() {
            self.buckets.insert(descriptor, FeatureNumber::new(number, at));
        }
        let slot = Slot { keyframe: Some(keyframe), features };
        match self.slots.get_mut(number) {
            Some(free) => *free = slot,
            None => self.slots.push(slot),
        }
        self.slot_of.insert(keyframe, number);
    }

    /// Removes a keyframe, if it is there.
    pub fn remove(&mut self, keyframe: KeyframeId) {
        let Some(number) = self.slot_of.remove(&keyframe) else { return };
        let slot = std::mem::take(&mut self.slots[number]);
        for (at, descriptor) in slot.features.descriptors.iter().enumerate() {
            self.buckets.remove(descriptor, FeatureNumber::new(number, at));
        }
        self.free.push(number);
    }

    /// The keyframes that show the ground of the query, at most `most`, best first, one hypothesis
    /// for each. All have geometrically consistent matches; [`PlaceHypothesis::is_sure`] says
    /// whether that is enough.
    pub fn query(&self, signature: &Signature, most: usize) -> Vec<PlaceHypothesis> {
        self.query_among(signature, most, &|_| true)
    }

    /// As [`PlaceIndex::query`], among the keyframes of which `compared` is true.
    pub fn query_among(
        &self,
        signature: &Signature,
        most: usize,
        compared: &dyn Fn(KeyframeId) -> bool,
    ) -> Vec<PlaceHypothesis> {
        let query = Features::new(&signature.features, self.spot_m);
        let mut found: Vec<_> = self
            .candidates(&query, compared, MAX_CANDIDATES)
            .into_iter()
            .filter_map(|(slot, placing)| {
                let slot = &self.slots[slot];
                let support = support(&query, &slot.features, placing)?;
                Some((slot.keyframe?, slot, support)).filter(|_| support.matches >= MIN_MATCHES)
            })
            .collect();
        found.sort_by(|a, b| b.2.worth.total_cmp(&a.2.worth).then(a.0.cmp(&b.0)));
        found.truncate(most);
        let mut hypotheses: Vec<_> = found
            .into_iter()
            .map(|(keyframe, slot, support)| {
                // A weak hypothesis needs no test for ambiguity.
                let is_relevant = support.worth >= WORTH_A_RIVAL;
                let rival = is_relevant.then(|| rival(&query, &slot.features, &support)).flatten();
                self.hypothesis(keyframe, &support, rival.map_or(0.0, |rival| rival.worth.into()))
            })
            .collect();
        hypotheses.sort_by(|a, b| b.score.total_cmp(&a.score).then(a.keyframe.cmp(&b.keyframe)));
        hypotheses
    }

    /// All motions over the keyframes that may show the ground of the query, at most `most`, those
    /// with the most worth first: on ground that repeats itself, a place and its lookalikes, which
    /// the images must tell apart. Takes some ten times as long as [`PlaceIndex::query`].
    pub fn lookalikes(
        &self,
        signature: &Signature,
        most: usize,
        compared: &dyn Fn(KeyframeId) -> bool,
    ) -> Vec<PlaceHypothesis> {
        let query = Features::new(&signature.features, self.spot_m);
        let mut found = Vec::new();
        for (slot, _) in self.candidates(&query, compared, MAX_ALIKE_KEYFRAMES) {
            let Slot { keyframe: Some(keyframe), features } = &self.slots[slot] else { continue };
            let supported = supported(&query, features).into_iter();
            let enough = supported.filter(|support| support.matches >= MIN_MATCHES);
            found.extend(enough.map(|support| self.hypothesis(*keyframe, &support, 0.0)));
        }
        found.sort_by(|a, b| b.worth.total_cmp(&a.worth).then(a.keyframe.cmp(&b.keyframe)));
        found.truncate(most);
        found
    }

    fn hypothesis(&self, keyframe: KeyframeId, support: &Support, rival_worth: f64) -> PlaceHypothesis {
        let Placing { shift, heading_rad, scale } = support.placing;
        let [x, y] = shift.map(|spots| f64::from(spots) * self.spot_m);
        let worth = f64::from(support.worth);
        PlaceHypothesis {
            keyframe,
            motion: Vector4::new(x, y, f64::from(heading_rad), f64::from(scale).ln()),
            ln_scale_deviation: support.ln_scale_deviation.into(),
            matches: support.matches,
            shared: support.shared,
            worth,
            rival_worth,
            score: (worth - rival_worth) / (worth + rival_worth).sqrt(),
        }
    }

    /// The keyframes to verify, at most `most`, each with the motion that most of its matches vote
    /// for.
    fn candidates(
        &self,
        query: &Features,
        compared: &dyn Fn(KeyframeId) -> bool,
        most: usize,
    ) -> Vec<(usize, Placing)> {
        let mut matches = self.look_up(query);
        matches.retain(|(number, ..)| self.slots[number.slot()].keyframe.is_some_and(compared));
        matches.sort_unstable();
        matches.dedup();
        // A single match is no evidence. The others are fetched before the first is examined, as in
        // `look_up`.
        let paired = matches.chunk_by(|a, b| a.0.slot() == b.0.slot()).filter(|group| group.len() > 1);
        let fetched = |&(number, feature, bits): &(FeatureNumber, usize, u32)| {
            let there = &self.slots[number.slot()].features;
            (number.slot(), FeatureMatch::new((query, feature), (there, number.feature()), bits))
        };
        let mut matches: Vec<(usize, FeatureMatch)> = paired.flatten().map(fetched).collect();
        matches.sort_unstable_by_key(|(slot, m)| (*slot, m.difference, m.query, m.keyframe));
        let mut candidates = Vec::new();
        let mut group = Vec::new();
        for of_slot in matches.chunk_by(|a, b| a.0 == b.0) {
            group.clear();
            group.extend(of_slot.iter().map(|(_, m)| *m));
            if let Some((placing, agreeing)) = best_pair(query, &group) {
                candidates.push((agreeing, of_slot[0].0, placing));
            }
        }
        candidates.sort_by_key(|&(agreeing, slot, _)| (Reverse(agreeing), slot));
        candidates.truncate(most);
        // Hypotheses with far fewer votes than the best are not examined.
        let most = candidates.first().map_or(0, |&(agreeing, ..)| agreeing);
        if most >= MANY_AGREEING {
            candidates.retain(|&(agreeing, ..)| FEW_OF_MANY * agreeing >= most);
        }
        candidates.into_iter().map(|(_, slot, placing)| (slot, placing)).collect()
    }

    /// The features in the same buckets as the query's that have similar descriptors.
    fn look_up(&self, query: &Features) -> Vec<(FeatureNumber, usize, u32)> {
        let leads = query.descriptors.iter().enumerate();
        let mut addresses: Vec<_> =
            leads.flat_map(|(number, descriptor)| self.buckets.lead(number, descriptor)).collect();
        addresses.sort_unstable();
        let mut left = MAX_COMPARISONS;
        let within = addresses.iter().take_while(|address| match left.checked_sub(address.features) {
            Some(rest) => {
                left = rest;
                true
            }
            None => false,
        });
        let within = within.count();
        let found = self.buckets.alike(&addresses[..within], &query.descriptors);
        // All are fetched before the first is compared: they are far apart in memory, and none has
        // to wait for another.
        let theirs = |&(other, _): &(FeatureNumber, u32)| {
            self.slots[other.slot()].features.descriptors[other.feature()]
        };
        let pairs: Vec<[[u64; 4]; 2]> =
            found.iter().map(|found| [theirs(found), query.descriptors[found.1 as usize]]).collect();
        let mut differences = vec![0; pairs.len()];
        differing_bits_of_pairs(&pairs, &mut differences);
        let alike = found.into_iter().zip(differences).filter(|(_, bits)| *bits <= MAX_DIFFERENCE);
        alike.map(|((other, number), bits)| (other, number as usize, bits)).collect()
    }
}
