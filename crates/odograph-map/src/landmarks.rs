//! The markers of a map, and where they are.

use crate::complaint::WithContext;
use crate::file::MapFile;
use crate::markers::{
    MapMarker, NAME, StoredKeyframe, StoredMarker, insert, is_there, marker_by, place, stored,
};
use odograph::error::Result;
use odograph::geometry::Se2;
use odograph::landmark::PlacedSighting;
use std::collections::{BTreeMap, BTreeSet};

/// A marker at a place, as all its sightings have it.
#[derive(Debug, Clone, PartialEq)]
pub struct MapLandmark {
    /// Family and dictionary, such as `apriltag:36h11`.
    pub family: String,
    /// Side of its black square as stated, metres.
    pub size_m: f64,
    /// Its number.
    pub number: u32,
    /// Where it is in the map: the mean of its sightings.
    pub pose: Se2,
    /// Standard deviation of x and y, by the best of its sightings, metres.
    pub sigma_m: f64,
    /// Number of its sightings.
    pub sightings: usize,
    /// The sessions that have seen it, in order.
    pub sessions: Vec<u32>,
    /// Time of its last sighting in its session, seconds.
    pub last_s: f64,
}

impl MapLandmark {
    fn of(seen: &[&MapMarker]) -> Option<Self> {
        let (first, last) = (seen.first()?, seen.last()?);
        let mean = |value: &dyn Fn(&Se2) -> f64| {
            seen.iter().map(|marker| value(&marker.pose)).sum::<f64>() / seen.len() as f64
        };
        let heading_rad = mean(&|pose| pose.heading_rad.sin()).atan2(mean(&|pose| pose.heading_rad.cos()));
        let sigma_m = |marker: &&MapMarker| {
            (0.5 * (marker.covariance[(0, 0)] + marker.covariance[(1, 1)])).max(0.0).sqrt()
        };
        let sessions: BTreeSet<u32> = seen.iter().map(|marker| marker.session).collect();
        Some(Self {
            family: first.family.clone(),
            size_m: first.size_m,
            number: first.placed.sighting.number,
            pose: Se2::new(mean(&|pose| pose.x_m), mean(&|pose| pose.y_m), heading_rad),
            sigma_m: seen.iter().map(sigma_m).fold(f64::INFINITY, f64::min),
            sightings: seen.len(),
            sessions: sessions.into_iter().collect(),
            last_s: last.time_s,
        })
    }
}

impl MapFile {
    /// The places of the markers, by family, size and number. Fails as [`MapFile::markers`].
    pub fn landmarks(&self) -> Result<Vec<MapLandmark>> {
        let markers = self.markers()?;
        let mut of_place: BTreeMap<(&str, u64, u32, usize), Vec<&MapMarker>> = BTreeMap::new();
        for marker in &markers {
            let PlacedSighting { sighting, place, .. } = &marker.placed;
            // Positive numbers are in the order of their bits.
            let key = (marker.family.as_str(), marker.size_m.to_bits(), sighting.number, *place);
            of_place.entry(key).or_default().push(marker);
        }
        Ok(of_place.values().filter_map(|seen| MapLandmark::of(seen)).collect())
    }

    /// The markers in the order in which they were seen; none in a map without them. Fails if one
    /// has a value that cannot be, or its keyframe is missing.
    pub fn markers(&self) -> Result<Vec<MapMarker>> {
        if !is_there(&self.connection).while_reading(&self.complaint)? {
            return Ok(Vec::new());
        }
        let stored = stored(&self.connection, 0).while_reading(&self.complaint)?;
        let marker = |(stored, keyframe): (StoredMarker, Option<StoredKeyframe>)| {
            let row = stored.row;
            marker_by(stored, keyframe)
                .map_err(|what| self.complaint.damage(format!("row {row} of {NAME} {what}")))
        };
        stored.into_iter().map(marker).collect()
    }

    /// Adds sightings of markers of a family (such as `apriltag:36h11`) and a size, metres, by
    /// keyframes of the map. All are stored when this returns, or none.
    pub fn add_markers(&mut self, family: &str, size_m: f64, sightings: &[PlacedSighting]) -> Result<()> {
        if sightings.is_empty() {
            return Ok(());
        }
        let transaction = self.connection.transaction().while_writing(&self.complaint)?;
        insert(&transaction, family, size_m, sightings)
            .and_then(|first| place(&transaction, first))
            .and_then(|()| transaction.commit())
            .while_writing(&self.complaint)
    }

    /// Replaces the sightings of a session, as [`MapFile::add_markers`] adds them.
    pub fn set_markers(
        &mut self,
        session: u32,
        family: &str,
        size_m: f64,
        sightings: &[PlacedSighting],
    ) -> Result<()> {
        let transaction = self.connection.transaction().while_writing(&self.complaint)?;
        (|| {
            if is_there(&transaction)? {
                transaction.execute("DELETE FROM marker_sightings WHERE session = ?1", [session])?;
            }
            if !sightings.is_empty() {
                insert(&transaction, family, size_m, sightings)?;
            }
            place(&transaction, 0)?;
            transaction.commit()
        })()
        .while_writing(&self.complaint)
    }
}
