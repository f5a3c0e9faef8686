//! T = T_root F: the transform of a domain that follows a transform root by a constant frame.

use nalgebra::Matrix3;

use super::Transform;

/// The factors of a domain's transform.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ComposedTransform {
    /// The domain's own transform or, for a follower, that of its root.
    pub root: Transform,
    /// F, `root_from_domain`; `None` for a domain with a transform of its own.
    pub frame: Option<Transform>,
}

impl From<Transform> for ComposedTransform {
    fn from(root: Transform) -> Self {
        Self { root, frame: None }
    }
}

impl ComposedTransform {
    /// `world_from_domain` in f32, as deformers apply it to positions. With row t of the root's transform and column f
    /// of the frame, an entry is `fma(t0, f0, fma(t1, f1, t2 f2))` and a translation is
    /// `fma(t0, f0, fma(t1, f1, fma(t2, f2, t3)))`: three roundings each. Bit-identical to `load_transform` in
    /// `kernels/transform.cuh`.
    pub fn to_f32(&self) -> Transform {
        let Some(Transform(f)) = self.frame else { return self.root };
        let mut product = [0.0; 12];
        for (t, out) in self.root.0.chunks_exact(4).zip(product.chunks_exact_mut(4)) {
            for (column, out) in out.iter_mut().enumerate() {
                let last = if column == 3 { t[2].mul_add(f[11], t[3]) } else { t[2] * f[8 + column] };
                *out = t[0].mul_add(f[column], t[1].mul_add(f[4 + column], last));
            }
        }
        Transform(product)
    }

    /// The product in f64, 3x4 row-major. Products of two f32 are exact in f64 and cannot overflow. Sums are evaluated
    /// from left to right as on the device, so that an entry that cancels to 0 here also does so there.
    pub fn to_f64(&self) -> [f64; 12] {
        let t = self.root.0.map(f64::from);
        let Some(frame) = self.frame else { return t };
        let f = frame.0.map(f64::from);
        std::array::from_fn(|at| {
            let (row, column) = (&t[at / 4 * 4..][..4], at % 4);
            let sum = row[0] * f[column] + row[1] * f[4 + column] + row[2] * f[8 + column];
            if column == 3 { sum + row[3] } else { sum }
        })
    }

    /// The linear part A of [`Self::to_f64`], which transforms normals and tangents.
    pub fn linear(&self) -> Matrix3<f64> {
        let entries = self.to_f64();
        Matrix3::from_fn(|row, column| entries[4 * row + column])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const T: Transform = Transform([0.0, -2.0, 0.5, 10.0, 2.0, 0.0, 0.25, -20.0, 0.0, 0.5, 2.0, 30.0]);
    const F: Transform = Transform([1.0, 0.5, 0.0, 3.0, 0.0, 4.0, 0.0, -1.0, 2.0, 0.0, 1.0, 0.5]);

    #[test]
    fn a_follower_is_where_its_mover_takes_its_frame_and_the_other_order_is_elsewhere() {
        let composed_transform = ComposedTransform { root: T, frame: Some(F) };
        // Small whole numbers and halves: every product and sum is exact in f32.
        assert_eq!(composed_transform.to_f32(), T.compose(F));
        assert_eq!(composed_transform.to_f64(), T.compose(F).0.map(f64::from));
        assert_eq!(composed_transform.linear(), T.linear() * F.linear());
        assert_ne!(composed_transform.to_f32(), F.compose(T), "the judge can fail");
        let own = ComposedTransform::from(T);
        assert_eq!((own.to_f32(), own.linear()), (T, T.linear()));
    }

    #[test]
    fn a_product_that_leaves_f32_is_kept_in_f64_and_one_that_cancels_vanishes() {
        let scaled = |scale: f32| Transform(Transform::IDENTITY.0.map(|entry| entry * scale));
        let huge = ComposedTransform { root: scaled(1e30), frame: Some(scaled(1e30)) };
        assert_eq!(huge.to_f32().0[0], f32::INFINITY);
        assert!((huge.to_f64()[0] / 1e60 - 1.0).abs() < 1e-6);
        let tiny = ComposedTransform { root: scaled(1e-30), frame: Some(scaled(1e-30)) };
        assert_eq!(tiny.to_f32().0[0], 0.0);
        assert!(tiny.linear().determinant() > 0.0);
        let mut flat = Transform::IDENTITY;
        (flat.0[0], flat.0[1]) = (0.1, -0.1);
        let mut ones = Transform::IDENTITY;
        (ones.0[0], ones.0[4]) = (1.0, 1.0);
        assert_eq!(ComposedTransform { root: flat, frame: Some(ones) }.to_f64()[0], 0.0);
    }
}
