//! Connected components of indices.

/// Disjoint sets of indices (union-find), represented by their smallest members.
#[derive(Debug)]
pub struct DisjointSets(Vec<u32>);

impl DisjointSets {
    /// One set per index.
    pub fn new(count: usize) -> Self {
        Self((0..count as u32).collect())
    }

    /// The smallest member of a set.
    pub fn find(&mut self, mut index: usize) -> usize {
        while self.0[index] as usize != index {
            self.0[index] = self.0[self.0[index] as usize];
            index = self.0[index] as usize;
        }
        index
    }

    /// Merges the sets of two indices.
    pub fn merge(&mut self, a: usize, b: usize) {
        let [a, b] = [self.find(a), self.find(b)];
        self.0[a.max(b)] = a.min(b) as u32;
    }

    /// The number of the set of each index, in the order of their first members, and the number of sets.
    pub fn into_numbers(mut self) -> (Vec<u32>, usize) {
        let mut count = 0;
        for index in 0..self.0.len() {
            // The smallest member of the set already has its number if it is not this index.
            let root = self.0[index] as usize;
            self.0[index] = if root == index {
                count += 1;
                count - 1
            } else {
                self.0[root]
            };
        }
        (self.0, count as usize)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_of_sets_ascend_with_their_first_members() {
        let mut sets = DisjointSets::new(6);
        sets.merge(4, 1);
        sets.merge(5, 4);
        sets.merge(2, 3);
        assert_eq!(sets.into_numbers(), (vec![0, 1, 2, 2, 1, 1], 4 - 1));
    }
}
