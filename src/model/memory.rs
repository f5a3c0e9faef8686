//! Budgets of memory. A scene reserves memory before it is allocated, so that a file that decodes to more than the machine
//! has is rejected, and the other scenes remain open.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use crate::error::{Error, Result};

/// The memory that a budget counts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MemoryKind {
    Host,
    Device,
    /// Images and buffers of frames that are drawn. In the place of a scene, a reservation is for one target.
    RenderTargets,
}

impl MemoryKind {
    const fn of_one_scene(self) -> &'static str {
        match self {
            Self::Host => "host memory of one scene",
            Self::Device => "device memory of one scene",
            Self::RenderTargets => "memory of one render target",
        }
    }

    const fn of_one_group(self) -> &'static str {
        match self {
            Self::Host => "host memory of the scenes of one principal",
            Self::Device => "device memory of the scenes of one principal",
            Self::RenderTargets => "memory of one group of render targets",
        }
    }

    const fn of_all_scenes(self) -> &'static str {
        match self {
            Self::Host => "host memory of all scenes",
            Self::Device => "device memory of all scenes",
            Self::RenderTargets => "memory of all render targets",
        }
    }
}

/// Limits on the memory that all scenes together and each scene may reserve.
#[derive(Debug)]
pub struct MemoryBudget {
    kind: MemoryKind,
    /// In bytes.
    total: u64,
    /// In bytes.
    per_scene: u64,
    reserved: AtomicU64,
}

impl MemoryBudget {
    /// A budget of `total` bytes for all scenes, and `per_scene` bytes for each.
    pub fn new(kind: MemoryKind, total: u64, per_scene: u64) -> Arc<Self> {
        Arc::new(Self { kind, total, per_scene, reserved: AtomicU64::new(0) })
    }

    /// Limit in bytes on all scenes together.
    pub const fn total(&self) -> u64 {
        self.total
    }

    /// Limit in bytes on one scene.
    pub const fn per_scene(&self) -> u64 {
        self.per_scene
    }

    /// Bytes that are reserved now.
    pub fn reserved(&self) -> u64 {
        self.reserved.load(Ordering::Relaxed)
    }
}

/// Scenes that may reserve only a part of a budget together: those of one principal.
#[derive(Debug)]
pub struct MemoryGroup {
    budget: Arc<MemoryBudget>,
    /// In bytes.
    total: u64,
    reserved: AtomicU64,
}

impl MemoryGroup {
    /// A group that may reserve `total` bytes.
    pub fn new(budget: &Arc<MemoryBudget>, total: u64) -> Arc<Self> {
        Arc::new(Self { budget: Arc::clone(budget), total, reserved: AtomicU64::new(0) })
    }
}

/// The memory that one scene has reserved. Dropping it returns the memory to the budget.
#[derive(Debug)]
pub struct MemoryReservation {
    group: Arc<MemoryGroup>,
    bytes: AtomicU64,
}

/// One of the limits of a reservation.
struct Level<'a> {
    memory: &'static str,
    total: u64,
    reserved: &'a AtomicU64,
}

impl MemoryReservation {
    /// Nothing reserved yet, for a scene that belongs to no group.
    pub fn new(budget: &Arc<MemoryBudget>) -> Arc<Self> {
        Self::in_group(&MemoryGroup::new(budget, budget.total))
    }

    /// Nothing reserved yet, for a scene of a group.
    pub fn in_group(group: &Arc<MemoryGroup>) -> Arc<Self> {
        Arc::new(Self { group: Arc::clone(group), bytes: AtomicU64::new(0) })
    }

    /// A reservation without limits, for scenes that the user of this machine opens.
    pub fn unlimited() -> Arc<Self> {
        Self::new(&MemoryBudget::new(MemoryKind::Host, u64::MAX, u64::MAX))
    }

    /// Bytes that are reserved now.
    pub fn bytes(&self) -> u64 {
        self.bytes.load(Ordering::Relaxed)
    }

    /// Reserves memory for an object until the scene is closed. `object` names it in the error.
    ///
    /// # Errors
    /// `OutOfMemory` if the limit of the scene, of its group or of all scenes is exceeded; nothing is then reserved.
    pub fn reserve(&self, object: &str, bytes: u64) -> Result<()> {
        let levels = self.levels();
        for (passed, level) in levels.iter().enumerate() {
            let Err(used) = add_up_to(level.reserved, bytes, level.total) else { continue };
            for level in &levels[..passed] {
                level.reserved.fetch_sub(bytes, Ordering::Relaxed);
            }
            return Err(Error::OutOfMemory {
                object: object.to_owned(),
                memory: level.memory,
                asked: bytes,
                available: level.total.saturating_sub(used),
                total: level.total,
            });
        }
        Ok(())
    }

    fn levels(&self) -> [Level<'_>; 3] {
        let (group, MemoryBudget { kind, total, per_scene, reserved }) = (&*self.group, &*self.group.budget);
        [
            Level { memory: kind.of_one_scene(), total: *per_scene, reserved: &self.bytes },
            Level { memory: kind.of_one_group(), total: group.total, reserved: &group.reserved },
            Level { memory: kind.of_all_scenes(), total: *total, reserved },
        ]
    }

    /// Reserves memory for an object that is freed when the returned guard is dropped.
    ///
    /// # Errors
    /// As for [`Self::reserve`].
    pub fn reserve_temporary(self: &Arc<Self>, object: &str, bytes: u64) -> Result<TemporaryReservation> {
        self.reserve(object, bytes)?;
        Ok(TemporaryReservation { reservation: Arc::clone(self), object: object.to_owned(), bytes })
    }

    /// Changes the reservation to `bytes`, when the size of the scene is known.
    ///
    /// # Errors
    /// As for [`Self::reserve`]; the reservation then remains unchanged.
    pub fn resize(&self, object: &str, bytes: u64) -> Result<()> {
        let reserved = self.bytes();
        match bytes.checked_sub(reserved) {
            Some(more) => self.reserve(object, more),
            None => {
                self.release(reserved - bytes);
                Ok(())
            }
        }
    }

    fn release(&self, bytes: u64) {
        for level in self.levels() {
            level.reserved.fetch_sub(bytes, Ordering::Relaxed);
        }
    }
}

impl Drop for MemoryReservation {
    fn drop(&mut self) {
        self.release(self.bytes());
    }
}

/// Memory that is reserved until this guard is dropped.
#[derive(Debug)]
pub struct TemporaryReservation {
    reservation: Arc<MemoryReservation>,
    object: String,
    bytes: u64,
}

impl TemporaryReservation {
    /// Bytes that are reserved now.
    pub const fn bytes(&self) -> u64 {
        self.bytes
    }

    /// Reserves more memory, in all `bytes`, before the object grows.
    ///
    /// # Errors
    /// As for [`MemoryReservation::reserve`].
    pub fn grow_to(&mut self, bytes: u64) -> Result<()> {
        let more = bytes.saturating_sub(self.bytes);
        self.reservation.reserve(&self.object, more)?;
        self.bytes += more;
        Ok(())
    }
}

impl Drop for TemporaryReservation {
    fn drop(&mut self) {
        self.reservation.release(self.bytes);
    }
}

/// Adds `bytes` to a counter unless the sum exceeds `limit`. Fails with the present value.
fn add_up_to(counter: &AtomicU64, bytes: u64, limit: u64) -> Result<(), u64> {
    let add = |used: u64| used.checked_add(bytes).filter(|sum| *sum <= limit);
    counter.fetch_update(Ordering::Relaxed, Ordering::Relaxed, add).map(drop)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn exceeded(result: Result<()>) -> (&'static str, u64, u64, u64) {
        match result {
            Err(Error::OutOfMemory { memory, asked, available, total, .. }) => (memory, asked, available, total),
            other => panic!("expected OutOfMemory, got {other:?}"),
        }
    }

    #[test]
    fn limits_of_a_scene_and_of_all_scenes_are_exact() {
        let budget = MemoryBudget::new(MemoryKind::Host, 100, 60);
        let [first, second] = [(); 2].map(|()| MemoryReservation::new(&budget));
        first.reserve("a", 60).expect("the limit of a scene");
        assert_eq!(exceeded(first.reserve("b", 1)), ("host memory of one scene", 1, 0, 60));
        assert_eq!(exceeded(second.reserve("c", 41)), ("host memory of all scenes", 41, 40, 100));
        assert_eq!((second.bytes(), budget.reserved()), (0, 60), "expected a rejected reservation to take nothing");
        assert_eq!(exceeded(second.reserve("d", u64::MAX)), ("host memory of one scene", u64::MAX, 60, 60));
        second.reserve("c", 40).expect("the limit of all scenes");
        drop(first);
        assert_eq!(budget.reserved(), 40);
    }

    #[test]
    fn a_group_leaves_memory_for_others() {
        let budget = MemoryBudget::new(MemoryKind::Host, 100, 60);
        let [group, other] = [(); 2].map(|()| MemoryGroup::new(&budget, 80));
        let [first, second] = [(); 2].map(|()| MemoryReservation::in_group(&group));
        first.reserve("a", 60).expect("the limit of a scene");
        assert_eq!(exceeded(second.reserve("b", 21)), ("host memory of the scenes of one principal", 21, 20, 80));
        assert_eq!((second.bytes(), budget.reserved()), (0, 60), "expected a rejected reservation to take nothing");
        second.reserve("b", 20).expect("the limit of the group");
        let of_other = MemoryReservation::in_group(&other);
        assert_eq!(exceeded(of_other.reserve("c", 21)), ("host memory of all scenes", 21, 20, 100));
        of_other.reserve("c", 20).expect("the rest");
        drop((first, second));
        MemoryReservation::in_group(&group).reserve("d", 60).expect("the memory of the dropped scenes");
    }

    #[test]
    fn temporary_and_resized_reservations_return_their_memory() {
        let budget = MemoryBudget::new(MemoryKind::Device, 100, 100);
        let scene = MemoryReservation::new(&budget);
        scene.reserve("a", 10).expect("a reservation within the limit");
        let mut buffer = scene.reserve_temporary("b", 30).expect("a reservation within the limit");
        buffer.grow_to(80).expect("a reservation within the limit");
        assert!(buffer.grow_to(91).is_err());
        assert_eq!(exceeded(scene.reserve("c", 20)), ("device memory of one scene", 20, 10, 100));
        drop(buffer);
        assert_eq!(budget.reserved(), 10);
        scene.resize("scene", 90).expect("a size within the limit");
        assert!(scene.resize("scene", 101).is_err());
        assert_eq!(budget.reserved(), 90);
        scene.resize("scene", 5).expect("a size within the limit");
        assert_eq!((scene.bytes(), budget.reserved()), (5, 5));
    }
}
