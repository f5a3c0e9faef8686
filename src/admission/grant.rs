//! What a pool, a permit and its handles share.

use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use tokio::sync::watch;

use super::account::Account;
use super::progress::{Progress, now};
use modalcast_model::error::Error;

/// A permit that was granted, shared by the [`super::Permit`], its handles and the pool.
#[derive(Debug)]
pub(super) struct Grant {
    pub(super) account: Mutex<Account>,
    pub(super) has_principal: AtomicBool,
    granted_at: u64,
    /// What the permit counts for. Changes only while the pool is locked.
    amount: AtomicUsize,
    pub(super) progress: Progress,
    /// The error of whatever the permit was granted for, once the permit is preempted.
    pub(super) preemption: watch::Sender<Option<Error>>,
}

/// No update can panic halfway, so a poisoned lock is valid.
pub(super) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Grant {
    pub(super) fn new(account: &Account, amount: usize) -> Arc<Self> {
        Arc::new(Self {
            account: Mutex::new(account.clone()),
            has_principal: AtomicBool::new(account.principal.is_some()),
            granted_at: now(),
            amount: AtomicUsize::new(amount),
            progress: Progress::default(),
            preemption: watch::Sender::new(None),
        })
    }

    pub(super) fn last_progress(&self) -> Option<u64> {
        self.progress.last()
    }

    pub(super) const fn granted_at(&self) -> u64 {
        self.granted_at
    }

    pub(super) fn amount(&self) -> usize {
        self.amount.load(Ordering::Relaxed)
    }

    /// Returns the former amount.
    pub(super) fn set_amount(&self, amount: usize) -> usize {
        self.amount.swap(amount, Ordering::Relaxed)
    }
}
