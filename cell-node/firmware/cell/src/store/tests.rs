use super::*;

const PAGE: usize = 1 << 10;

/// Two simulated flash pages that lose power after `left` writes.
struct Simulated {
    pages: [[u8; PAGE]; 2],
    left: usize,
}

impl Simulated {
    fn new() -> Self {
        Self { pages: [[0xFF; PAGE]; 2], left: usize::MAX }
    }

    fn use_power(&mut self) -> Result<(), WriteError> {
        self.left = self.left.checked_sub(1).ok_or(WriteError)?;
        Ok(())
    }

    fn held(&self) -> Result<Vec<u8>, StoredImage> {
        let mut image = [0; MAX_IMAGE];
        match read(self, &mut image) {
            StoredImage::Image(len) => Ok(image[..len].to_vec()),
            other => Err(other),
        }
    }
}

impl Flash for Simulated {
    fn unit(&self, page: Page, at: usize) -> [u8; WRITE_SIZE] {
        self.pages[page as usize][at..at + WRITE_SIZE].try_into().unwrap()
    }

    fn erase(&mut self, page: Page) -> Result<(), WriteError> {
        self.use_power()?;
        self.pages[page as usize] = [0xFF; PAGE];
        Ok(())
    }

    fn program(&mut self, page: Page, at: usize, unit: [u8; WRITE_SIZE]) -> Result<(), WriteError> {
        self.use_power()?;
        let bytes = &mut self.pages[page as usize][at..at + WRITE_SIZE];
        assert_eq!(bytes, ERASED, "each unit is written once");
        bytes.copy_from_slice(&unit);
        Ok(())
    }
}

fn image(of: u8, len: usize) -> Vec<u8> {
    (0..=255).cycle().take(len).map(|byte: u8| of.wrapping_mul(31).wrapping_add(byte)).collect()
}

#[test]
fn the_newest_image_is_read_and_its_length_is_kept() {
    let mut flash = Simulated::new();
    assert_eq!(flash.held(), Err(StoredImage::Nothing));
    for (of, len) in [(1, 133), (2, 0), (3, 7), (4, 8), (5, MAX_IMAGE), (6, 145)] {
        write(&mut flash, &image(of, len)).unwrap();
        assert_eq!(flash.held(), Ok(image(of, len)));
    }
    assert_eq!(write(&mut flash, &[0; MAX_IMAGE + 1]), Err(WriteError));
    assert_eq!(flash.held(), Ok(image(6, 145)), "the old one still counts");
}

#[test]
fn an_image_of_ff_comes_back_too() {
    let mut flash = Simulated::new();
    write(&mut flash, &[0xFF; 40]).unwrap();
    assert_eq!(flash.held(), Ok(vec![0xFF; 40]));
}

// CONF-7, CONF-8
#[test]
fn a_loss_of_power_at_any_moment_leaves_the_old_image_or_the_new_one() {
    for before in 0..4_u8 {
        let mut prepared = Simulated::new();
        for of in 1..=before {
            write(&mut prepared, &image(of, 133)).unwrap();
        }
        let old = prepared.held();
        let mut moments = 0;
        for left in 0.. {
            let mut flash = Simulated { pages: prepared.pages, left };
            if write(&mut flash, &image(9, 145)).is_ok() {
                assert_eq!(flash.held(), Ok(image(9, 145)));
                break;
            }
            assert_eq!(flash.held(), old, "{before} images, power for {left} writes");
            moments += 1;
            flash.left = usize::MAX;
            write(&mut flash, &image(10, 40)).unwrap();
            assert_eq!(flash.held(), Ok(image(10, 40)), "the next attempt");
        }
        assert!(moments > 18);
    }
}

// CONF-8
#[test]
fn damage_is_noticed_and_gone_after_the_next_image() {
    let mut sound = Simulated::new();
    write(&mut sound, &image(1, 133)).unwrap();
    write(&mut sound, &image(2, 133)).unwrap();
    for (page, at) in [(0, 4), (0, 8 + 136), (1, 5), (1, 8 + 136 + 3)] {
        let mut flash = Simulated { pages: sound.pages, left: usize::MAX };
        flash.pages[page][at] = 0x55;
        assert_eq!(flash.held(), Err(StoredImage::Damaged), "byte {at} of page {page}");
        write(&mut flash, &image(3, 133)).unwrap();
        assert_eq!(flash.held(), Ok(image(3, 133)));
    }
    // Damage within the image itself is detected by its CRC.
    sound.pages[1][20] ^= 1;
    assert_ne!(sound.held(), Ok(image(2, 133)));
}

#[test]
fn the_number_of_an_image_may_wrap() {
    let mut flash = Simulated::new();
    let unit = [[0xFF, 0xFF, 0xFF, 0x7F], 8_u32.to_le_bytes()].concat();
    flash.pages[0][..8].copy_from_slice(&unit);
    flash.pages[0][8..16].copy_from_slice(b"an image");
    flash.pages[0][16..24].copy_from_slice(COMPLETE);
    assert_eq!(flash.held(), Ok(b"an image".to_vec()));
    write(&mut flash, &image(2, 8)).unwrap();
    assert_eq!(flash.held(), Ok(image(2, 8)));
}
