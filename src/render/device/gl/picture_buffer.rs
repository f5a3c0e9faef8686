//! A picture in memory that OpenGL shares with another API, which copies the pixels to the host. Copies are started
//! when the host has seen OpenGL's fence, and are polled.

use std::cell::RefCell;
use std::rc::Rc;
use std::time::{Duration, Instant};

use super::staging::{ReadbackView, ReaderSignal};
use super::{Buffer, BufferCopy, Gl};
use modalcast_model::error::{Result, fault};
use modalcast_model::shared_memory::{CopyRequest, PictureMemory, PngRequest, SharedPicture};

/// Time limit of the commands of [`check_sharing`].
const CHECK_TIMEOUT: Duration = Duration::from_secs(10);
/// Words of the picture of [`check_sharing`].
const CHECK_WORDS: usize = 1 << 16;
/// Rounds of [`check_sharing`]. Later rounds would see the words of earlier ones if an API read outdated memory.
const CHECK_ROUNDS: u32 = 8;

/// A shared picture as an OpenGL buffer.
#[derive(Debug)]
pub(crate) struct PictureBuffer {
    // Dropped before the picture: OpenGL releases its reference first.
    pub(crate) buffer: Buffer,
    copy: RefCell<PictureCopy>,
    reader: ReaderSignal,
}

/// The picture, and the state of its copy.
#[derive(Debug)]
struct PictureCopy {
    picture: Box<dyn SharedPicture>,
    /// The PNG file of the present frame; `None`: pixels only.
    png: Option<PngRequest>,
    /// Whether a copy of the present frame was started, or the error of the start.
    started: Option<Result<()>>,
}

impl PictureCopy {
    /// Starts the copy of the first `bytes` bytes unless it is started.
    fn start(&mut self, bytes: usize) -> Result<()> {
        let Self { picture, png, started } = self;
        started.get_or_insert_with(|| picture.start_copy(CopyRequest { bytes, png: *png })).clone()
    }
}

impl PictureBuffer {
    /// Allocates a picture and imports it.
    ///
    /// # Errors
    /// `Fault` when the memory cannot be allocated or imported.
    pub(crate) fn new(gl: &Rc<Gl>, memory: &dyn PictureMemory, bytes: u64) -> Result<Self> {
        let picture_bytes = usize::try_from(bytes).map_err(|_| fault("import", "expected a smaller picture"))?;
        let picture = memory.create_picture(picture_bytes)?;
        let buffer = Buffer::import(gl, picture.descriptor, picture.allocated_bytes, bytes)?;
        let copy = RefCell::new(PictureCopy { picture: picture.picture, png: None, started: None });
        Ok(Self { buffer, copy, reader: ReaderSignal::default() })
    }

    /// Requests the PNG file of the present frame, whose copy is not started yet.
    pub(crate) fn request_png(&self, request: PngRequest) {
        self.copy.borrow_mut().png = Some(request);
    }

    /// Starts the copy unless it is started. Waits at most `limit`. Returns whether [`Self::view`] would return without
    /// waiting. The caller has waited for the fence after the last command that writes the picture.
    pub(crate) fn is_copied_within(&self, limit: Duration) -> bool {
        let begin = Instant::now();
        let mut copy = self.copy.borrow_mut();
        if copy.start(self.buffer.bytes as usize).is_err() {
            return true; // `view` returns the error.
        }
        loop {
            if copy.picture.is_copied() {
                return true;
            }
            if begin.elapsed() >= limit {
                return false;
            }
            std::thread::yield_now();
        }
    }

    /// Waits for the copy and returns its first `bytes` bytes. The caller has waited for the fence after the last
    /// command that writes the picture. `can_be_held`: whether a reader may keep the view for long.
    ///
    /// # Errors
    /// `Fault` when the device cannot copy the picture.
    pub(crate) fn view(&self, bytes: usize, can_be_held: bool) -> Result<ReadbackView> {
        let mut copy = self.copy.borrow_mut();
        let result = copy.start(self.buffer.bytes as usize).and_then(|()| copy.picture.finish_copy());
        (copy.started, copy.png) = (None, None);
        Ok(ReadbackView::pinned(result?, bytes, can_be_held, &self.reader))
    }

    /// Waits at most `limit` for the reader and returns whether it is done.
    pub(crate) fn is_read(&self, limit: Duration) -> bool {
        self.abandon_copy();
        self.reader.is_read(limit)
    }

    /// Ends a copy whose frame was abandoned.
    fn abandon_copy(&self) {
        let mut copy = self.copy.borrow_mut();
        copy.png = None;
        if copy.started.take().is_some_and(|result| result.is_ok()) {
            // The error of an abandoned copy concerns no frame. A failed device reports its error again.
            copy.picture.finish_copy().ok();
        }
    }
}

/// Checks that OpenGL and the API of `memory` see each other's words in a shared picture. Both write and both read, in
/// several rounds with different words.
///
/// # Errors
/// `Fault` with the first difference, or with the reason why the memory cannot be shared.
pub(crate) fn check_sharing(gl: &Rc<Gl>, memory: &dyn PictureMemory) -> Result<()> {
    let bytes = 4 * CHECK_WORDS;
    let shared = PictureBuffer::new(gl, memory, bytes as u64)?;
    let own = gl.buffer(bytes as u64, super::STREAM_COPY, None)?;
    for round in 0..CHECK_ROUNDS {
        let words: Vec<u32> = (0..CHECK_WORDS as u32).map(|index| index.wrapping_mul(0x9e37_79b9) ^ round).collect();
        own.write(bytemuck::cast_slice(&words));
        gl.copy(BufferCopy::first(bytes as u64, &own, &shared.buffer));
        gl.check("shared memory")?;
        gl.wait("shared memory", CHECK_TIMEOUT)?;
        let view = shared.view(bytes, false)?;
        expect_words("the words that OpenGL wrote", bytemuck::cast_slice(&words), view.bytes())?;
        drop(view);
        let word = 0x1234_5678 ^ round;
        shared.copy.borrow_mut().picture.fill(word)?;
        gl.copy(BufferCopy::first(bytes as u64, &shared.buffer, &own));
        gl.check("shared memory")?;
        gl.wait("shared memory", CHECK_TIMEOUT)?;
        let words = vec![word; CHECK_WORDS];
        expect_words("the words that OpenGL should read", bytemuck::cast_slice(&words), &own.read(bytes)?)?;
    }
    Ok(())
}

fn expect_words(content: &str, expected: &[u8], got: &[u8]) -> Result<()> {
    let different = expected.chunks_exact(4).zip(got.chunks_exact(4)).filter(|(expected, got)| expected != got).count();
    if different == 0 && expected.len() == got.len() {
        return Ok(());
    }
    let words = expected.len() / 4;
    Err(fault("shared memory", format!("{content}: expected {words} equal words, got {different} different ones")))
}

#[cfg(test)]
pub(crate) mod testing {
    //! Emulates shared pictures on a machine without CUDA.

    use std::cell::Cell;
    use std::os::fd::OwnedFd;
    use std::sync::Arc;

    use super::*;
    use crate::device::gl::StagingBuffer;
    use modalcast_model::shared_memory::{CopiedPixels, HostPixels, NewPicture};

    /// A mapped buffer of OpenGL instead of memory that OpenGL shares.
    #[derive(Debug)]
    struct EmulatedPicture {
        memory: StagingBuffer,
        pixels: Arc<EmulatedPixels>,
        is_copying: bool,
        /// Whether a poll has returned that the copy is in flight. Each copy seems to take longer than one poll.
        is_polled: Cell<bool>,
    }

    #[derive(Debug)]
    struct EmulatedPixels(Vec<u8>);

    impl HostPixels for EmulatedPixels {
        fn bytes(&self) -> &[u8] {
            &self.0
        }
    }

    impl SharedPicture for EmulatedPicture {
        fn start_copy(&mut self, CopyRequest { bytes, .. }: CopyRequest) -> Result<()> {
            let in_use = || fault("emulated picture", "expected no copy in flight and no reader");
            let pixels = Arc::get_mut(&mut self.pixels).filter(|_| !self.is_copying).ok_or_else(in_use)?;
            pixels.0 = self.memory.view(bytes)?.bytes().to_vec();
            (self.is_copying, self.is_polled) = (true, Cell::new(false));
            Ok(())
        }

        fn is_copied(&self) -> bool {
            !self.is_copying || self.is_polled.replace(true)
        }

        fn finish_copy(&mut self) -> Result<CopiedPixels> {
            assert!(std::mem::take(&mut self.is_copying), "expected a copy in flight");
            Ok(CopiedPixels { pixels: Arc::clone(&self.pixels) as Arc<dyn HostPixels>, png: None })
        }

        fn fill(&mut self, _: u32) -> Result<()> {
            Ok(())
        }
    }

    impl PictureBuffer {
        /// A picture that is copied by the host.
        pub(crate) fn emulated(gl: &Rc<Gl>, bytes: u64) -> Self {
            let memory = gl.staging(bytes).expect("a mapped buffer");
            let buffer = memory.buffer.alias();
            let pixels = Arc::new(EmulatedPixels(Vec::new()));
            let picture = EmulatedPicture { memory, pixels, is_copying: false, is_polled: Cell::default() };
            let copy = RefCell::new(PictureCopy { picture: Box::new(picture), png: None, started: None });
            Self { buffer, copy, reader: ReaderSignal::default() }
        }
    }

    /// Exports files instead of device memory: OpenGL must refuse them, or see other words than the host.
    #[derive(Debug, Default)]
    pub(crate) struct UnsharedMemory {
        pub(crate) picture_count: Cell<usize>,
    }

    /// A picture that OpenGL does not share.
    #[derive(Debug)]
    struct UnsharedPicture(usize);

    impl PictureMemory for UnsharedMemory {
        fn create_picture(&self, bytes: usize) -> Result<NewPicture> {
            self.picture_count.set(self.picture_count.get() + 1);
            let file = std::fs::File::open("/dev/zero").expect("a file");
            let picture = Box::new(UnsharedPicture(bytes));
            Ok(NewPicture { descriptor: OwnedFd::from(file), allocated_bytes: bytes as u64, picture })
        }
    }

    impl SharedPicture for UnsharedPicture {
        fn start_copy(&mut self, _: CopyRequest) -> Result<()> {
            Ok(())
        }

        fn is_copied(&self) -> bool {
            true
        }

        fn finish_copy(&mut self) -> Result<CopiedPixels> {
            Ok(CopiedPixels { pixels: Arc::new(EmulatedPixels(vec![0; self.0])), png: None })
        }

        fn fill(&mut self, _: u32) -> Result<()> {
            Ok(())
        }
    }
}

#[cfg(test)]
mod tests {
    use super::testing::UnsharedMemory;
    use super::*;
    use crate::{DevicePreference, device};

    #[test]
    fn memory_that_opengl_does_not_share_fails_the_check() {
        let (gl, _) = device::open(DevicePreference::Any).expect("EGL");
        let memory = UnsharedMemory::default();
        let error = check_sharing(&gl, &memory).expect_err("a failed check").to_string();
        assert!(error.contains("import") || error.contains("words"), "{error}");
        assert_eq!(memory.picture_count.get(), 1);
        gl.check("test").expect("no error of OpenGL after the check");
    }

    #[test]
    fn words_that_differ_are_counted() {
        expect_words("test", &[1; 16], &[1; 16]).expect("equal words");
        let error =
            expect_words("test", &[1; 16], &[1, 1, 1, 1, 1, 1, 1, 2, 1, 1, 1, 1, 0, 1, 1, 1]).expect_err("two words");
        assert!(error.to_string().contains("expected 4 equal words, got 2 different ones"), "{error}");
        expect_words("test", &[1; 16], &[1; 12]).expect_err("a missing word");
    }
}
