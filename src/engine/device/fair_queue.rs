//! Deficit round-robin (Shreedhar and Varghese 1996) over scenes, by the measured cost of their work on the device
//! thread.
//!
//! Each scene has a bounded queue in the order of its submissions. The scenes with work form a ring. In each round, a
//! scene gains [`QUANTUM_MS`] of device time, and spends it on the work at the head of its queue. The cost of work is
//! an estimate: the running mean of the measured times of earlier work of the same kind and size in the same scene.
//! Once work is measured, the scene is charged the measured time instead. So a scene with many or slow commands does
//! not delay the others beyond its share, and a scene that is alone never waits.
//!
//! A scene that runs out of work loses the time that it has saved, but not its debt, which is at most [`MAX_DEBT_MS`].
//! Work that cannot run yet, for example because the device has not finished its last step, delays no other scene.

use std::collections::{HashMap, VecDeque};

use super::command::{CostClass, SceneId};

/// Milliseconds that a scene gains in each round: about the time of a few frames on a GPU.
const QUANTUM_MS: f64 = 5.0;
/// Maximum debt of a scene in milliseconds, so that a scene soon pays back work that is slow only once, such as
/// loading.
const MAX_DEBT_MS: f64 = 100.0;
/// Weight of a new measurement in the running mean of costs.
const COST_WEIGHT: f64 = 0.25;

/// Identifies queued work, to remove it.
pub(super) type Ticket = u64;

/// Queued work of type `T`.
#[derive(Debug)]
struct Entry<T> {
    ticket: Ticket,
    class: CostClass,
    work: T,
}

#[derive(Debug)]
struct SceneQueue<T> {
    entries: VecDeque<Entry<T>>,
    /// Device time in milliseconds that the scene may use in this round; negative after work that took longer.
    deficit_ms: f64,
    /// Running means of costs in milliseconds. The number of classes is bounded by the kinds of work and the sizes of
    /// frames.
    costs: HashMap<CostClass, f64>,
}

impl<T> SceneQueue<T> {
    fn new() -> Self {
        Self { entries: VecDeque::new(), deficit_ms: 0.0, costs: HashMap::new() }
    }

    fn cost_ms(&self, class: CostClass) -> f64 {
        self.costs.get(&class).copied().unwrap_or(0.0)
    }

    /// Rounds after which the scene can afford the work at the head of its queue.
    fn rounds_until_affordable(&self) -> f64 {
        let head_cost_ms = self.entries.front().map_or(0.0, |head| self.cost_ms(head.class));
        ((head_cost_ms - self.deficit_ms) / QUANTUM_MS).ceil().max(0.0)
    }
}

/// Work that was taken from the queue.
#[derive(Debug, PartialEq)]
pub(super) struct Taken<T> {
    pub scene: SceneId,
    pub class: CostClass,
    /// Estimated cost in milliseconds that the scene was charged.
    pub charged_ms: f64,
    pub ticket: Ticket,
    pub work: T,
}

/// The queues of all scenes.
#[derive(Debug)]
pub(super) struct FairQueue<T> {
    scenes: HashMap<SceneId, SceneQueue<T>>,
    /// Scenes with work. The scene at the front may spend its time.
    ring: VecDeque<SceneId>,
    next_ticket: Ticket,
}

impl<T> FairQueue<T> {
    pub(super) fn new() -> Self {
        Self { scenes: HashMap::new(), ring: VecDeque::new(), next_ticket: 0 }
    }

    pub(super) fn is_empty(&self) -> bool {
        self.ring.is_empty()
    }

    /// Number of queued entries of a scene.
    pub(super) fn len(&self, scene: SceneId) -> usize {
        self.scenes.get(&scene).map_or(0, |queue| queue.entries.len())
    }

    /// Appends work to the queue of a scene. The caller limits the length of the queue.
    pub(super) fn push(&mut self, scene: SceneId, class: CostClass, work: T) -> Ticket {
        self.insert(scene, class, work, VecDeque::push_back)
    }

    /// Puts unfinished work back at the head of its scene's queue, and ends the turn of the scene.
    pub(super) fn push_front(&mut self, scene: SceneId, class: CostClass, work: T) {
        self.insert(scene, class, work, VecDeque::push_front);
        if self.ring.front() == Some(&scene) {
            self.ring.rotate_left(1);
        }
    }

    /// Puts taken work back at the head of its scene's queue, and refunds the charge.
    pub(super) fn return_taken(&mut self, taken: Taken<T>) {
        let Taken { scene, class, charged_ms, ticket, work } = taken;
        self.push_front(scene, class, work);
        if let Some(queue) = self.scenes.get_mut(&scene) {
            queue.deficit_ms += charged_ms;
            if let Some(head) = queue.entries.front_mut() {
                head.ticket = ticket;
            }
        }
    }

    fn insert(
        &mut self,
        scene: SceneId,
        class: CostClass,
        work: T,
        push: fn(&mut VecDeque<Entry<T>>, Entry<T>),
    ) -> Ticket {
        let ticket = self.next_ticket;
        self.next_ticket += 1;
        let queue = self.scenes.entry(scene).or_insert_with(SceneQueue::new);
        if queue.entries.is_empty() {
            self.ring.push_back(scene);
            // A scene begins with a new quantum, less its debt.
            queue.deficit_ms = queue.deficit_ms.min(0.0) + QUANTUM_MS;
        }
        push(&mut queue.entries, Entry { ticket, class, work });
        ticket
    }

    /// Removes work that is still queued. Returns it, or `None` if it was taken.
    pub(super) fn remove(&mut self, scene: SceneId, ticket: Ticket) -> Option<T> {
        let queue = self.scenes.get_mut(&scene)?;
        let index = queue.entries.iter().position(|entry| entry.ticket == ticket)?;
        let entry = queue.entries.remove(index)?;
        if queue.entries.is_empty() {
            // Takes back the quantum, so that cancelled work does not reduce the debt.
            queue.deficit_ms = (queue.deficit_ms - QUANTUM_MS).max(-MAX_DEBT_MS);
        }
        self.leave_ring_if_empty(scene);
        Some(entry.work)
    }

    /// Takes the work whose turn it is and charges its scene the estimated cost. Work for
    /// which `can_run` returns false is passed over. `None` if no work can run.
    pub(super) fn take(&mut self, can_run: impl Fn(SceneId, &T) -> bool) -> Option<Taken<T>> {
        let Self { scenes, ring, .. } = self;
        let is_runnable = |queue: &SceneQueue<T>, scene: SceneId| {
            queue.entries.front().is_some_and(|head| can_run(scene, &head.work))
        };
        let runnable: Vec<SceneId> = ring.iter().copied().filter(|scene| is_runnable(&scenes[scene], *scene)).collect();
        // Skips all rounds in which no scene can afford its work: adds their quanta at once.
        let rounds = runnable.iter().map(|scene| scenes[scene].rounds_until_affordable());
        let rounds = rounds.min_by(f64::total_cmp)?;
        if rounds > 1.0 {
            for scene in &runnable {
                if let Some(queue) = scenes.get_mut(scene) {
                    queue.deficit_ms += (rounds - 1.0) * QUANTUM_MS;
                }
            }
        }
        // One round adds the last quantum, and the next one takes the work.
        for _ in 0..2 * ring.len() {
            let scene = *ring.front()?;
            let queue = scenes.get_mut(&scene)?;
            if runnable.contains(&scene) {
                if queue.rounds_until_affordable() == 0.0 {
                    return self.take_head(scene);
                }
                queue.deficit_ms += QUANTUM_MS;
            }
            ring.rotate_left(1);
        }
        runnable.first().and_then(|scene| self.take_head(*scene))
    }

    fn take_head(&mut self, scene: SceneId) -> Option<Taken<T>> {
        let queue = self.scenes.get_mut(&scene)?;
        let Entry { ticket, class, work } = queue.entries.pop_front()?;
        let charged_ms = queue.cost_ms(class);
        queue.deficit_ms -= charged_ms;
        self.leave_ring_if_empty(scene);
        Some(Taken { scene, class, charged_ms, ticket, work })
    }

    /// Charges a scene the measured time of work instead of `charged_ms`, and updates the estimate of its class.
    pub(super) fn record_cost(&mut self, scene: SceneId, class: CostClass, charged_ms: f64, measured_ms: f64) {
        let Some(queue) = self.scenes.get_mut(&scene) else { return };
        let mean_ms = queue.costs.entry(class).or_insert(measured_ms);
        *mean_ms += COST_WEIGHT * (measured_ms - *mean_ms);
        self.charge(scene, measured_ms - charged_ms);
    }

    /// Reduces the time that a scene may use.
    pub(super) fn charge(&mut self, scene: SceneId, ms: f64) {
        if let Some(queue) = self.scenes.get_mut(&scene) {
            queue.deficit_ms = (queue.deficit_ms - ms).max(-MAX_DEBT_MS);
        }
    }

    /// Forgets the costs of a scene without work.
    pub(super) fn forget(&mut self, scene: SceneId) {
        if self.len(scene) == 0 {
            self.scenes.remove(&scene);
        }
    }

    #[cfg(test)]
    pub(super) fn reset_costs(&mut self) {
        for queue in self.scenes.values_mut() {
            (queue.deficit_ms, queue.costs) = (0.0, HashMap::new());
        }
    }

    fn leave_ring_if_empty(&mut self, scene: SceneId) {
        if self.len(scene) == 0 {
            self.ring.retain(|ringed_scene| *ringed_scene != scene);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SMALL: CostClass = CostClass { kind: "small", size_class: 0 };
    const LARGE: CostClass = CostClass { kind: "large", size_class: 20 };

    fn cost_ms(class: CostClass) -> f64 {
        if class == LARGE { 200.0 } else { 1.0 }
    }

    /// Takes up to `count` entries, records their costs, and returns their scenes.
    fn take_scenes(queue: &mut FairQueue<u32>, count: usize) -> Vec<SceneId> {
        let mut scenes = Vec::new();
        for _ in 0..count {
            let Some(Taken { scene, class, charged_ms, .. }) = queue.take(|_, _| true) else { break };
            queue.record_cost(scene, class, charged_ms, cost_ms(class));
            scenes.push(scene);
        }
        scenes
    }

    fn count_of(scenes: &[SceneId], scene: SceneId) -> usize {
        scenes.iter().filter(|taken_scene| **taken_scene == scene).count()
    }

    #[test]
    fn scenes_share_device_time_equally() {
        let mut queue = FairQueue::new();
        for number in 0..20 {
            queue.push(1, LARGE, number);
        }
        for number in 0..5000 {
            queue.push(2, SMALL, number);
        }
        let scenes = take_scenes(&mut queue, 2000);
        let (large_ms, small_ms) = (200 * count_of(&scenes, 1), count_of(&scenes, 2));
        // The scenes differ by at most the cost of one entry, and the work that was taken before any cost was measured.
        assert!(large_ms.abs_diff(small_ms) <= 600, "{large_ms} and {small_ms} ms");
        // Negative control: in the order of submission, the first scene would have used all the time.
        assert!(small_ms > 1000, "{small_ms} ms");
    }

    #[test]
    fn scene_with_many_commands_does_not_delay_another_scene() {
        let mut queue = FairQueue::new();
        for number in 0..100 {
            queue.push(1, LARGE, number);
        }
        take_scenes(&mut queue, 3);
        queue.push(2, SMALL, 0);
        assert_eq!(take_scenes(&mut queue, 1), [2]);
        // A scene that is alone does not wait.
        assert_eq!(take_scenes(&mut queue, 100).len(), 97);
        assert!(queue.is_empty() && queue.take(|_, _| true).is_none());
    }

    #[test]
    fn work_of_a_scene_keeps_its_order() {
        let mut queue = FairQueue::new();
        for number in 0..50_u32 {
            queue.push(1, if number % 3 == 0 { LARGE } else { SMALL }, number);
            queue.push(2, SMALL, number);
        }
        let mut numbers = HashMap::<SceneId, Vec<u32>>::new();
        while let Some(Taken { scene, class, charged_ms, work, .. }) = queue.take(|_, _| true) {
            queue.record_cost(scene, class, charged_ms, cost_ms(class));
            numbers.entry(scene).or_default().push(work);
            // Unfinished work continues before later work.
            if work == 7 && numbers[&scene].iter().filter(|number| **number == 7).count() < 3 {
                queue.push_front(scene, class, work);
            }
        }
        let expected: Vec<u32> = (0..7).chain([7, 7, 7]).chain(8..50).collect();
        assert_eq!((&numbers[&1], &numbers[&2]), (&expected, &expected));
    }

    #[test]
    fn work_that_cannot_run_delays_no_other_scene() {
        let mut queue = FairQueue::new();
        queue.push(1, SMALL, 10);
        queue.push(1, SMALL, 11);
        queue.push(2, SMALL, 20);
        assert_eq!(queue.take(|scene, _| scene != 1).map(|taken| taken.work), Some(20));
        assert_eq!(queue.take(|scene, _| scene != 1), None);
        assert_eq!(queue.take(|_, _| true).map(|taken| taken.work), Some(10));
    }

    #[test]
    fn removed_work_leaves_the_queue_at_once() {
        let mut queue = FairQueue::new();
        let tickets: Vec<Ticket> = (0..3).map(|number| queue.push(1, SMALL, number)).collect();
        assert_eq!(queue.remove(1, tickets[1]), Some(1));
        assert_eq!((queue.len(1), queue.remove(1, tickets[1]), queue.remove(2, tickets[0])), (2, None, None));
        assert_eq!(queue.take(|_, _| true).map(|taken| taken.work), Some(0));
        assert_eq!(queue.remove(1, tickets[0]), None, "expected no removal of taken work");
        assert_eq!(queue.remove(1, tickets[2]), Some(2));
        assert!(queue.is_empty());
    }

    #[test]
    fn debt_is_bounded_and_remains_while_a_scene_has_no_work() {
        let mut queue = FairQueue::new();
        queue.push(1, SMALL, 0);
        let Taken { charged_ms, .. } = queue.take(|_, _| true).expect("expected work");
        queue.record_cost(1, SMALL, charged_ms, 10_000.0);
        for number in 0..200 {
            queue.push(2, LARGE, number);
            queue.record_cost(2, LARGE, 0.0, 0.0);
        }
        // Cancelled work does not reduce the debt.
        for _ in 0..50 {
            let ticket = queue.push(1, CostClass { kind: "new", ..SMALL }, 0);
            queue.remove(1, ticket);
        }
        queue.push(1, CostClass { kind: "new", ..SMALL }, 1);
        let mut other_ms = 0.0;
        while let Some(Taken { scene, class, charged_ms, .. }) = queue.take(|_, _| true) {
            queue.record_cost(scene, class, charged_ms, 1.0);
            if scene == 1 {
                break;
            }
            other_ms += 1.0;
        }
        assert!((MAX_DEBT_MS - 2.0 * QUANTUM_MS..=MAX_DEBT_MS + 2.0 * QUANTUM_MS).contains(&other_ms), "{other_ms} ms");
    }
}
