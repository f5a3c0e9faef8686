//! The world transform of a domain as a product, T = T_root F. A follower is a domain that moves with its root domain.
//! F, its frame, is the constant transform from the follower's coordinates to those of the root.

use nalgebra::Matrix3;

use super::Transform;

/// The factors of a domain's transform.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ComposedTransform {
    /// T_root: the transform of the root of a follower. A domain that follows no other is its own root.
    pub root: Transform,
    /// F, `root_from_domain`. `None` for a root.
    pub frame: Option<Transform>,
}

impl From<Transform> for ComposedTransform {
    fn from(root: Transform) -> Self {
        Self { root, frame: None }
    }
}

impl ComposedTransform {
    /// `world_from_domain` in f32, as deformers apply it to positions. With a row t of T_root and a column f of F, an
    /// entry of the linear part is `fma(t0, f0, fma(t1, f1, t2 f2))`, and an entry of the translation is
    /// `fma(t0, f0, fma(t1, f1, fma(t2, f2, t3)))`. Each entry is rounded three times. The result is bit-identical to
    /// that of `load_transform` in `kernels/transform.cuh`.
    pub fn to_f32(&self) -> Transform {
        let Some(Transform(f)) = self.frame else { return self.root };
        let mut product = [0.0; 12];
        for (t, product_row) in self.root.0.chunks_exact(4).zip(product.chunks_exact_mut(4)) {
            for (column, out) in product_row.iter_mut().enumerate() {
                let innermost_term = if column == 3 { t[2].mul_add(f[11], t[3]) } else { t[2] * f[8 + column] };
                *out = t[0].mul_add(f[column], t[1].mul_add(f[4 + column], innermost_term));
            }
        }
        Transform(product)
    }

    /// `world_from_domain` in f64, 3x4 row-major. Products of two f32 are exact in f64 and cannot overflow. Sums are
    /// evaluated from left to right, as in the kernels. Thus an entry that cancels to 0 here is also 0 in the kernels.
    pub fn to_f64(&self) -> [f64; 12] {
        let t = self.root.0.map(f64::from);
        let Some(frame) = self.frame else { return t };
        let f = frame.0.map(f64::from);
        std::array::from_fn(|index| {
            let (row, column) = (&t[index / 4 * 4..][..4], index % 4);
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
    fn root_transform_is_applied_after_the_frame() {
        let composed_transform = ComposedTransform { root: T, frame: Some(F) };
        // Small multiples of 1/4: every product and sum is exact in f32.
        assert_eq!(composed_transform.to_f32(), T.compose(F));
        assert_eq!(composed_transform.to_f64(), T.compose(F).0.map(f64::from));
        assert_eq!(composed_transform.linear(), T.linear() * F.linear());
        assert_ne!(composed_transform.to_f32(), F.compose(T), "expected another product in the other order");
        let root = ComposedTransform::from(T);
        assert_eq!((root.to_f32(), root.linear()), (T, T.linear()));
    }

    #[test]
    fn f64_product_keeps_the_range_and_cancels_to_zero() {
        let scaling = |scale: f32| Transform(Transform::IDENTITY.0.map(|entry| entry * scale));
        // In f32, 1e30^2 overflows and 1e-30^2 underflows.
        let overflowing = ComposedTransform { root: scaling(1e30), frame: Some(scaling(1e30)) };
        assert_eq!(overflowing.to_f32().0[0], f32::INFINITY);
        assert!((overflowing.to_f64()[0] / 1e60 - 1.0).abs() < 1e-6);
        let underflowing = ComposedTransform { root: scaling(1e-30), frame: Some(scaling(1e-30)) };
        assert_eq!(underflowing.to_f32().0[0], 0.0);
        assert!(underflowing.linear().determinant() > 0.0);
        // 0.1 * 1 + (-0.1) * 1 is exactly 0.
        let mut opposite_entries = Transform::IDENTITY;
        (opposite_entries.0[0], opposite_entries.0[1]) = (0.1, -0.1);
        let mut column_of_ones = Transform::IDENTITY;
        (column_of_ones.0[0], column_of_ones.0[4]) = (1.0, 1.0);
        assert_eq!(ComposedTransform { root: opposite_entries, frame: Some(column_of_ones) }.to_f64()[0], 0.0);
    }
}
