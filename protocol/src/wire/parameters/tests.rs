use super::*;
use proptest::prelude::*;

fn sound() -> Parameters {
    let mut rows = [Row::default(); MAX_ROWS];
    rows[0] = Row { a: Q1_14::nearest(0.5), alpha: Q1_14::nearest(1.0), ..Row::default() };
    Parameters {
        joint: 1,
        joints: 2,
        pose: Pose {
            position: [Q1_14::nearest(0.1); 3],
            normal: [Q1_14::ZERO, Q1_14::ZERO, Q1_14::nearest(1.0)],
        },
        contact: Contact { alpha_c: Q3_12::nearest(1.0), ..Contact::default() },
        period_us: 16_000,
        rows,
        ..Parameters::default()
    }
}

#[test]
fn every_parameter_number_comes_back() {
    for number in 0..=u8::MAX {
        if let Some(parameter) = Parameter::from_number(number) {
            assert_eq!(parameter.number(), number);
        }
    }
    assert_eq!(Parameter::from_number(47), Some(Parameter::Row(31)));
    assert_eq!(Parameter::from_number(48), None);
    let volatile = (0..=u8::MAX).filter(|&it| Parameter::from_number(it).is_some_and(Parameter::is_volatile));
    assert!(volatile.eq([5, 6, 7, 8, 9, 11, 12]));
}

#[test]
fn what_is_wrong_is_said() {
    assert_eq!(sound().check(), Ok(()));
    let wrong = Parameters { joint: 3, ..sound() };
    assert_eq!(wrong.check().unwrap_err().to_string(), "joint 3 does not exist; the chain has joints 1 to 2");
    assert!(Parameters { joints: 15, ..sound() }.check().is_err());
    assert!(Parameters { period_us: 0, ..sound() }.check().is_err());
    assert!(Parameters { pose: Pose::default(), ..sound() }.check().is_err());
    let contact = Contact { force_threshold: Q5_10::from_bits(-1), ..Contact::default() };
    assert_eq!(Parameters { contact, ..sound() }.check(), Err(ParameterError::Negative { word: 4, got: -1 }));
}

#[test]
fn the_hash_sees_every_word() {
    let hash = sound().hash();
    for parameter in Parameter::stored_for_rows(2) {
        let mut other = sound();
        let mut words = other.words(parameter);
        words[0] ^= 1;
        other.set(parameter, words).unwrap();
        assert_ne!(other.hash(), hash, "{parameter:?}");
    }
}

#[test]
fn rows_are_checked_against_the_joints() {
    let rows = |row, table_rows, kinds: &[RowKind]| {
        let mut parameters = Parameters { row, table_rows, ..sound() };
        for (row, &kind) in parameters.rows.iter_mut().zip(kinds) {
            row.kind = kind;
        }
        parameters
    };
    let [turns, slides, fixed] = RowKind::ALL;
    // Joint 1 of 2 moves the cell.
    assert_eq!(rows(1, 2, &[slides, turns]).check(), Ok(()));
    assert_eq!(rows(3, 4, &[fixed, turns, fixed, turns]).check(), Ok(()));
    assert_eq!(rows(3, 4, &[fixed, turns, fixed, turns]).rows_to_cell().len(), 3);
    let code = |parameters: Parameters| parameters.check().unwrap_err().code();
    assert_eq!(code(rows(0, 0, &[slides])), 7, "the short form has revolute rows only");
    assert_eq!(code(rows(1, 33, &[turns, turns])), 7);
    assert_eq!(code(rows(1, 3, &[turns, turns, turns])), 7, "three joints");
    assert_eq!(code(rows(0, 2, &[turns, turns])), 8);
    assert_eq!(code(rows(2, 2, &[turns, turns])), 8, "joint 2 moves that row");
    assert_eq!(code(rows(1, 0, &[turns, turns])), 8);
    let says = rows(1, 3, &[turns, turns, fixed, turns]);
    assert_eq!(says.check(), Ok(()));
    assert_eq!(
        rows(4, 3, &[turns, turns, fixed]).check().unwrap_err().to_string(),
        "row 4 of 3 cannot carry the cell; use the row of the cell's joint, or a fixed row after it"
    );
    let mut kind = sound();
    assert_eq!(kind.set(Parameter::Row(3), [0, 0, 0, 0, 3, 0]).unwrap_err().code(), 9);
    assert_eq!(kind.set(Parameter::Mount, [1, 2, 0, 0, 3, 0]).unwrap_err().code(), 10);
    assert_eq!(kind, sound(), "nothing is changed");
}

#[test]
fn a_longer_table_has_a_longer_image() {
    let mut long = Parameters { joint: 1, joints: 2, row: 5, table_rows: 9, ..sound() };
    for row in 0..9 {
        long.rows[row] = Row {
            kind: if row < 1 || row == 8 { RowKind::Revolute } else { RowKind::Fixed },
            d: Q1_14::from_bits(3),
            ..Row::default()
        };
    }
    assert_eq!(long.encode_image().len(), IMAGE_BYTES + 3 * 12);
    assert_eq!(
        Parameters::from_image(&long.encode_image()).map(|it| it.encode_image()),
        Ok(long.encode_image())
    );
    assert_eq!(Parameters::from_image(&long.encode_image()[..IMAGE_BYTES + 24]).unwrap_err().code(), 7);
    let mut other = long;
    other.rows[8].d = Q1_14::from_bits(4);
    assert_ne!(other.hash(), long.hash());
    assert_eq!(Parameters { row: 1, table_rows: 2, ..sound() }.shortest_form(), sound());
}

proptest! {
    #[test]
    fn an_image_comes_back(k in 1_u8..=6, words in any::<[[i16; 4]; 6]>(), period_us in 1_u16..) {
        let mut target = Parameters { joint: k, joints: 6, period_us, ..sound() };
        for (row, [a, d, alpha, offset]) in target.rows.iter_mut().zip(words) {
            *row = Row { kind: RowKind::Revolute, a: Q1_14::from_bits(a), d: Q1_14::from_bits(d), alpha: Q1_14::from_bits(alpha), theta_offset: Q1_14::from_bits(offset) };
        }
        prop_assert_eq!(Parameters::from_image(&target.encode_image()), Ok(target));
    }

    #[test]
    fn no_image_panics(bytes in proptest::collection::vec(any::<u8>(), 0..=MAX_IMAGE_BYTES + 9)) {
        let _ = Parameters::from_image(&bytes);
    }
}
