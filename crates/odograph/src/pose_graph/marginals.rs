//! Selected elements of the inverse of a sparse matrix, from its Cholesky factor.

use nalgebra_sparse::CscMatrix;

/// The inverse on the sparsity pattern of the factor: K. Takahashi, J. Fagan and M. Chin,
/// "Formation of a sparse bus impedance matrix", 1973.
pub struct InverseOnPattern<'a> {
    factor: &'a CscMatrix<f64>,
    values: Vec<f64>,
}

/// The inverse of L Lᵀ on the pattern of L.
///
/// Column by column from the last: with l = L / its diagonal, Z(i, j) = δ(i, j) / L(j, j)² − Σ l(k,
/// j) Z(i, k) over the k > j in column j. All the Z that this needs are on the pattern.
pub fn on_pattern(factor: &CscMatrix<f64>) -> InverseOnPattern<'_> {
    let (offsets, rows, l) = factor.csc_data();
    let mut values = vec![0.0; l.len()];
    for j in (0..factor.ncols()).rev() {
        // Row indices ascend, so the diagonal comes first.
        let (first, last) = (offsets[j], offsets[j + 1]);
        let below = &rows[first + 1..last];
        let mut sums = vec![0.0; below.len()];
        for (b, &k) in below.iter().enumerate() {
            let part = l[first + 1 + b] / l[first];
            // Column k has all rows of column j that are not above k.
            let mut at = offsets[k];
            for (a, &i) in below.iter().enumerate().skip(b) {
                while rows[at] < i {
                    at += 1;
                }
                sums[a] += part * values[at];
                if a != b {
                    sums[b] += l[first + 1 + a] / l[first] * values[at];
                }
            }
        }
        let mut diagonal = 1.0 / (l[first] * l[first]);
        for (a, sum) in sums.into_iter().enumerate() {
            values[first + 1 + a] = -sum;
            diagonal += l[first + 1 + a] / l[first] * sum;
        }
        values[first] = diagonal;
    }
    InverseOnPattern { factor, values }
}

impl InverseOnPattern<'_> {
    /// An element of the inverse in the lower triangle; 0 off the pattern.
    pub fn get(&self, row: usize, column: usize) -> f64 {
        let (offsets, rows, _) = self.factor.csc_data();
        let (first, last) = (offsets[column], offsets[column + 1]);
        rows[first..last].binary_search(&row).map_or(0.0, |at| self.values[first + at])
    }
}
