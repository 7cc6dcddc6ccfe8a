//! Writes finished files to the disk and then renames them. This may take longer than a recorder can wait, so a thread
//! does it for one file after the other.

use std::fs::File;
use std::io;
use std::path::PathBuf;
use std::sync::mpsc::{self, Receiver, Sender};
use std::thread::{self, JoinHandle};

use super::names::{self, PartFile};
use crate::files::sync_folder;

/// A finished file with its temporary name, and data for the caller that is returned with its final name.
#[derive(Debug)]
pub(super) struct CompleteFile<T> {
    /// The file, which stays locked until it is renamed.
    pub(super) file: File,
    pub(super) part: PartFile,
    pub(super) about: T,
}

/// A file with its final name.
#[derive(Debug)]
pub(super) struct PublishedFile<T> {
    /// The final name; `None` if another program renamed or removed the file.
    pub(super) path: Option<PathBuf>,
    pub(super) about: T,
    /// An error message if the file does not have the requested name.
    pub(super) error: Option<String>,
}

/// The thread that renames finished files, and the files that it has renamed.
#[derive(Debug)]
pub(super) struct Publisher<T> {
    force: bool,
    running: Option<(Sender<CompleteFile<T>>, JoinHandle<()>)>,
    sender: Sender<PublishedFile<T>>,
    published: Receiver<PublishedFile<T>>,
}

impl<T: Send + 'static> Publisher<T> {
    /// Creates a publisher that replaces other files only if `force` is true.
    pub(super) fn new(force: bool) -> Self {
        let (sender, published) = mpsc::channel();
        Self { force, running: None, sender, published }
    }

    /// Passes a finished file to the thread.
    pub(super) fn publish(&mut self, ended: CompleteFile<T>) {
        if self.running.is_none() {
            self.running = self.start().ok();
        }
        let unsent = match &self.running {
            Some((sender, _)) => sender.send(ended).err().map(|mpsc::SendError(ended)| ended),
            None => Some(ended),
        };
        if let Some(ended) = unsent {
            // Without a thread the recorder renames the file itself; new messages meanwhile wait in its queue.
            let _ = self.sender.send(publish(ended, self.force));
        }
    }

    fn start(&self) -> io::Result<(Sender<CompleteFile<T>>, JoinHandle<()>)> {
        let (sender, receiver) = mpsc::channel::<CompleteFile<T>>();
        let (published, force) = (self.sender.clone(), self.force);
        let work = move || {
            for ended in receiver {
                let _ = published.send(publish(ended, force));
            }
        };
        Ok((sender, thread::Builder::new().name("sync".into()).spawn(work)?))
    }

    /// Returns the files that were renamed since the last call.
    pub(super) fn drain_published(&self) -> impl Iterator<Item = PublishedFile<T>> {
        self.published.try_iter()
    }

    /// Waits until all files are renamed.
    pub(super) fn finish(&mut self) {
        if let Some((sender, thread)) = self.running.take() {
            drop(sender);
            // The panic hook has already reported a panic of the thread.
            let _ = thread.join();
        }
    }
}

/// Writes a file to the disk before it is renamed, so that a file with its final name is complete even after a loss of
/// power.
fn publish<T>(CompleteFile { file, part, about }: CompleteFile<T>, force: bool) -> PublishedFile<T> {
    let named = file.sync_all().and_then(|()| part.finish(force));
    match named {
        Ok(()) => {
            sync_folder(&part.goal);
            PublishedFile { path: Some(part.goal), about, error: None }
        }
        Err(error) => {
            let (goal, there) = (part.goal.display(), part.path.display());
            if !part.has_temporary_name() {
                let error = format!(
                    "{there}: another program renamed, removed or replaced this file while it was being \
                     written; the recording is complete, but its place is unknown, so its contents count as \
                     lost"
                );
                return PublishedFile { path: None, about, error: Some(error) };
            }
            let error = if error.kind() == io::ErrorKind::AlreadyExists {
                names::name_conflict_message(&part.goal)
            } else {
                format!("{goal}: {error}")
            };
            let error = Some(format!("{error}; {there} is the complete recording: rename it"));
            PublishedFile { path: Some(part.path), about, error }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_whole_file_whose_name_is_taken_is_not_to_be_repaired() {
        let folder = tempfile::tempdir().unwrap();
        let goal = folder.path().join("run.mcap");
        let (part, file) = PartFile::create(goal.clone()).unwrap();
        std::fs::write(&goal, "another program's").unwrap();
        let published = publish(CompleteFile { file, part, about: () }, false);
        let error = published.error.unwrap();
        assert!(
            error.contains("run.mcap: another program has meanwhile created a file with this name; "),
            "{error}"
        );
        assert!(error.ends_with("run.mcap.part is the complete recording: rename it"), "{error}");
        assert_eq!(published.path, Some(folder.path().join("run.mcap.part")));
    }
}
