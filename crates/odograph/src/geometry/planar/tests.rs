use super::*;
use proptest::prelude::*;

prop_compose! {
    fn similarities()(x_m in -5.0..5.0, y_m in -5.0..5.0, heading_rad in -9.0..9.0, scale in 0.3..3.0) -> Sim2 {
        Sim2 { x_m, y_m, heading_rad, scale }
    }
}

prop_compose! {
    fn rigids()(x_m in -5.0..5.0, y_m in -5.0..5.0, heading_rad in -9.0..9.0) -> Se2 {
        Se2 { x_m, y_m, heading_rad }
    }
}

/// Sim(2)'s matrices: exp of the generator of (vx, vy, rotation, ln scale).
fn exp(xi: &Vector4<f64>) -> Sim2 {
    let generator = Matrix3::new(xi[3], -xi[2], xi[0], xi[2], xi[3], xi[1], 0.0, 0.0, 0.0);
    let matrix = generator.exp();
    let (cos, sin) = (matrix[(0, 0)], matrix[(1, 0)]);
    Sim2 { x_m: matrix[(0, 2)], y_m: matrix[(1, 2)], heading_rad: sin.atan2(cos), scale: cos.hypot(sin) }
}

/// Central differences of a function of a transform's numbers.
fn numeric(at: &Sim2, of: impl Fn(&Sim2) -> Sim2) -> Matrix4<f64> {
    const STEP: f64 = 1e-6;
    let mut jacobian = Matrix4::zeros();
    for column in 0..4 {
        let stepped = |step: f64| {
            let mut stepped = at.to_vector();
            stepped[column] += step;
            of(&Sim2::from_vector(&stepped)).to_vector()
        };
        jacobian.set_column(column, &((stepped(STEP) - stepped(-STEP)) / (2.0 * STEP)));
    }
    jacobian
}

fn near(a: &Sim2, b: &Sim2) -> bool {
    (a.to_vector() - b.to_vector()).amax() < 1e-9
}

proptest! {
    #[test]
    fn a_transform_times_its_inverse_is_the_identity(t in similarities(), r in rigids()) {
        prop_assert!(near(&(t * t.inverse()), &Sim2::IDENTITY) && near(&(t.inverse() * t), &Sim2::IDENTITY));
        prop_assert!(near(&Sim2::rigid(&(r * r.inverse())), &Sim2::IDENTITY));
    }

    #[test]
    fn products_are_associative_and_apply_one_after_the_other(a in similarities(), b in similarities(), c in similarities(),
                                                              x in -5.0..5.0, y in -5.0..5.0) {
        prop_assert!(near(&((a * b) * c), &(a * (b * c))));
        let point = GroundPoint::new(x, y);
        prop_assert!((a * b).apply(point).distance(a.apply(b.apply(point))) < 1e-9);
        let rigid = Se2::new(a.x_m, a.y_m, a.heading_rad);
        prop_assert!((rigid * rigid).apply(point).distance(rigid.apply(rigid.apply(point))) < 1e-9);
    }

    #[test]
    fn between_leads_from_one_to_the_other(a in similarities(), b in similarities(), p in rigids(), q in rigids()) {
        prop_assert!(near(&(a * a.between(&b)), &b));
        prop_assert!(near(&a.between(&b), &(a.inverse() * b)));
        prop_assert!(near(&Sim2::rigid(&(p * p.between(&q))), &Sim2::rigid(&q)));
    }

    #[test]
    fn the_adjoint_moves_a_small_motion_to_the_other_side(a in similarities(), x in -1.0..1.0, y in -1.0..1.0,
                                                         turn in -1.0..1.0, scale in -0.5..0.5) {
        let xi = Vector4::new(x, y, turn, scale);
        prop_assert!(near(&(a * exp(&xi) * a.inverse()), &exp(&(a.adjoint() * xi))));
        let rigid = Se2::new(a.x_m, a.y_m, a.heading_rad);
        let flat = Vector4::new(x, y, turn, 0.0);
        let moved = rigid.adjoint() * flat.xyz();
        let moved = exp(&Vector4::new(moved[0], moved[1], moved[2], 0.0));
        prop_assert!(near(&(Sim2::rigid(&rigid) * exp(&flat) * Sim2::rigid(&rigid.inverse())), &moved));
    }

    #[test]
    fn jacobians_are_those_of_numeric_differences(a in similarities(), b in similarities()) {
        let close = |exact: Matrix4<f64>, numeric: Matrix4<f64>| (exact - numeric).amax() < 1e-6;
        prop_assert!(close(a.product_by_left(&b), numeric(&a, |a| *a * b)));
        prop_assert!(close(a.product_by_right(), numeric(&b, |b| a * *b)));
        prop_assert!(close(a.between_by_from(&a.between(&b)), numeric(&a, |a| a.between(&b))));
        prop_assert!(close(a.between_by_to(), numeric(&b, |b| a.between(b))));
        // A frame fixed to a: its pose in the world is a · b.
        let world = a * b;
        prop_assert!(close(Sim2::lever_arm(world.x_m - a.x_m, world.y_m - a.y_m), numeric(&a, |a| *a * b)));
    }

    #[test]
    fn covariance_survives_two_inverses_and_a_product_with_the_exact(a in similarities(), b in similarities(),
                                                                     seed in proptest::array::uniform16(-1.0..1.0f64)) {
        let half = Matrix4::from_row_slice(&seed);
        let uncertain = WithCovariance { transform: a, covariance: half * half.transpose() };
        let off = |one: &WithCovariance<Sim2, 4>, other: &WithCovariance<Sim2, 4>| (one.covariance - other.covariance).amax();
        prop_assert!(off(&uncertain, &uncertain.inverse().inverse()) < 1e-8);
        let exact = |transform| WithCovariance { transform, covariance: Matrix4::zeros() };
        let (there, back) = (exact(b), exact(b.inverse()));
        prop_assert!(off(&uncertain, &(back * (there * uncertain))) < 1e-8);
        prop_assert!(off(&uncertain, &(uncertain * there * back)) < 1e-8);
    }

    #[test]
    fn a_similarity_takes_one_pose_to_another(from in rigids(), to in rigids(), heights in (0.3..3.0f64, 0.3..3.0f64)) {
        let pose = |at: &Se2, height_m: f64| GroundPose {
            x_m: at.x_m, y_m: at.y_m, heading_rad: at.heading_rad, ..GroundPose::level(height_m)
        };
        let (from, to) = (pose(&from, heights.0), pose(&to, heights.1));
        let moved = from.similarity_to(&to).apply_to_pose(&from);
        prop_assert!((moved.to_vector() - to.to_vector()).amax() < 1e-12 * 20.0);
        prop_assert_eq!(from.similarity_to(&from), Sim2::IDENTITY);
    }
}
