//! Numbers between numpy and the libraries.

use crate::error::{Failure, Result};
use nalgebra::{Isometry3, Matrix3, Matrix6, Rotation3, Translation3, UnitQuaternion};
use numpy::ndarray::{Array1, Array2, Array3};
use numpy::{IntoPyArray, PyArray1, PyArray2, PyArray3, PyReadonlyArrayDyn};
use pyo3::prelude::*;

pub type Vector<'py> = Bound<'py, PyArray1<f64>>;
pub type Matrix<'py> = Bound<'py, PyArray2<f64>>;
pub type Matrices<'py> = Bound<'py, PyArray3<f64>>;

/// Anything that numpy can make an array of numbers from: its shape, and the numbers in row order.
/// `name` is the argument's.
pub fn numbers(name: &str, given: &Bound<'_, PyAny>) -> Result<(Vec<usize>, Vec<f64>)> {
    let py = given.py();
    let array = py
        .import("numpy")?
        .call_method1("asarray", (given, "float64"))
        .map_err(|error| Failure::usage(format!("{name} is no array of numbers: {}", error.value(py))))?;
    let array: PyReadonlyArrayDyn<'_, f64> = array.extract().map_err(PyErr::from)?;
    Ok((array.as_array().shape().to_vec(), array.as_array().iter().copied().collect()))
}

/// A vector.
pub fn vector(py: Python<'_>, values: Vec<f64>) -> Vector<'_> {
    Array1::from_vec(values).into_pyarray(py)
}

/// A 4×4 homogeneous transform.
pub fn transform<'py>(py: Python<'py>, isometry: &Isometry3<f64>) -> Matrix<'py> {
    let matrix = isometry.to_homogeneous();
    Array2::from_shape_fn((4, 4), |(row, column)| matrix[(row, column)]).into_pyarray(py)
}

/// N×4×4 homogeneous transforms.
pub fn transforms<'py>(py: Python<'py>, isometries: &[Isometry3<f64>]) -> Matrices<'py> {
    let matrices: Vec<_> = isometries.iter().map(Isometry3::to_homogeneous).collect();
    Array3::from_shape_fn((matrices.len(), 4, 4), |(at, row, column)| matrices[at][(row, column)])
        .into_pyarray(py)
}

/// A 6×6 covariance.
pub fn covariance<'py>(py: Python<'py>, matrix: &Matrix6<f64>) -> Matrix<'py> {
    Array2::from_shape_fn((6, 6), |(row, column)| matrix[(row, column)]).into_pyarray(py)
}

/// N×6×6 covariances.
pub fn covariances<'py>(py: Python<'py>, matrices: &[Matrix6<f64>]) -> Matrices<'py> {
    Array3::from_shape_fn((matrices.len(), 6, 6), |(at, row, column)| matrices[at][(row, column)])
        .into_pyarray(py)
}

/// How far the product of a rotation with its transpose may be from the identity: files with six
/// decimals are closer.
const ORTHOGONAL: f64 = 1e-4;

/// The transform of a 4×4 matrix in row order; `None` if it is not rigid.
pub fn isometry(rows: &[f64]) -> Option<Isometry3<f64>> {
    let block = Matrix3::from_fn(|row, column| rows[4 * row + column]);
    let off = (block * block.transpose() - Matrix3::identity()).amax();
    // The maximum of values with NaN among them may be NaN or a number.
    let is_finite = rows.iter().all(|number| number.is_finite());
    let is_rigid =
        is_finite && off < ORTHOGONAL && block.determinant() > 0.0 && rows[12..] == [0.0, 0.0, 0.0, 1.0];
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(block));
    is_rigid.then(|| Isometry3::from_parts(Translation3::new(rows[3], rows[7], rows[11]), rotation))
}
