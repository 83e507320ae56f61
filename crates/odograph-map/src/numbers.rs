//! Encoding of matrices in the file: little-endian doubles; symmetric matrices as their upper
//! triangle in row-major order.

use nalgebra::SMatrix;

/// Encodes the upper triangle of a symmetric matrix.
pub(crate) fn bytes_from_symmetric<const N: usize>(matrix: &SMatrix<f64, N, N>) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(4 * N * (N + 1));
    for row in 0..N {
        for column in row..N {
            bytes.extend_from_slice(&matrix[(row, column)].to_le_bytes());
        }
    }
    bytes
}

/// Whether this can be stored as a covariance: its numbers are finite, and no variance is negative.
/// A map with any other is not read.
pub fn is_covariance<const N: usize>(matrix: &SMatrix<f64, N, N>) -> bool {
    matrix.iter().all(|value| value.is_finite()) && (0..N).all(|at| matrix[(at, at)] >= 0.0)
}

/// Decodes a symmetric matrix; `None` if the length is wrong or it is no covariance
/// ([`is_covariance`]).
pub(crate) fn symmetric_from_bytes<const N: usize>(bytes: &[u8]) -> Option<SMatrix<f64, N, N>> {
    if bytes.len() != 4 * N * (N + 1) {
        return None;
    }
    let mut numbers =
        bytes.chunks_exact(8).map(|eight| f64::from_le_bytes(eight.try_into().unwrap_or_default()));
    let mut matrix = SMatrix::zeros();
    for row in 0..N {
        for column in row..N {
            let value = numbers.next()?;
            (matrix[(row, column)], matrix[(column, row)]) = (value, value);
        }
    }
    is_covariance(&matrix).then_some(matrix)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Matrix4;

    #[test]
    fn symmetric_matrices_round_trip_and_invalid_bytes_are_rejected() {
        let half = Matrix4::from_fn(|row, column| (row as f64 + 0.3).sin() * (column as f64 + 0.7).cos());
        let matrix = half * half.transpose();
        let matrix = 0.5 * (matrix + matrix.transpose());
        let bytes = bytes_from_symmetric(&matrix);
        assert_eq!(bytes.len(), 80);
        assert_eq!(symmetric_from_bytes::<4>(&bytes), Some(matrix));
        assert_eq!(symmetric_from_bytes::<4>(&bytes[1..]), None, "cut");
        assert_eq!(symmetric_from_bytes::<6>(&bytes), None, "of another size");
        let with = |row: usize, column: usize, value: f64| {
            let mut wrong = matrix;
            wrong[(row, column)] = value;
            symmetric_from_bytes::<4>(&bytes_from_symmetric(&wrong))
        };
        assert_eq!(with(0, 1, f64::NAN), None);
        assert_eq!(with(2, 2, -1e-9), None);
    }
}
