//! Which client has the writer lease of a scene, for lists of clients.

use std::sync::{Arc, Mutex};

use crate::admission::Account;
use crate::engine::lock::lock;

/// The client that has the writer lease of a scene. A clone is shallow.
#[derive(Debug, Clone, Default)]
pub(super) struct CurrentWriter(Arc<Mutex<Option<Writer>>>);

#[derive(Debug)]
struct Writer {
    run: u64,
    account: Account,
}

/// The entry of the writer of a run, until it is dropped.
#[derive(Debug)]
pub(super) struct CurrentWriterEntry {
    writer: CurrentWriter,
    run: u64,
}

impl CurrentWriter {
    pub(super) fn account(&self) -> Option<Account> {
        lock(&self.0).as_ref().map(|writer| writer.account.clone())
    }

    /// Records the client that begins a run, unless a later run has begun.
    pub(super) fn record(&self, run: u64, account: Account) -> CurrentWriterEntry {
        let mut writer = lock(&self.0);
        if writer.as_ref().is_none_or(|writer| writer.run < run) {
            *writer = Some(Writer { run, account });
        }
        CurrentWriterEntry { writer: self.clone(), run }
    }
}

impl Drop for CurrentWriterEntry {
    fn drop(&mut self) {
        lock(&self.writer.0).take_if(|writer| writer.run == self.run);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::admission::Client;

    #[test]
    fn writer_of_the_latest_run_is_the_current_one() {
        let current = CurrentWriter::default();
        let account = |number| Account::anonymous(Client::Connection(number));
        assert_eq!(current.account(), None);
        let first = current.record(1, account(1));
        let third = current.record(3, account(3));
        let second = current.record(2, account(2));
        drop((first, second));
        assert_eq!(current.account(), Some(account(3)));
        drop(third);
        assert_eq!(current.account(), None);
    }
}
