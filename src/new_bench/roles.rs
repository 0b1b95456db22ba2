// SPDX-License-Identifier: MIT OR Apache-2.0
//! Which of the cameras that answer is which of the rig's: pure.

use super::found::Found;
use crate::base::ids::CameraId;

/// How a camera came to its name, the surest first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Known {
    /// The option --camera names it.
    Said,
    /// The node file has its address.
    InFile,
    /// Its own user-defined name is the rig's.
    ByUserName,
    /// It is the only one without a name on the wire of its head.
    ByPulse,
    /// It is the one whose lens the operator covered.
    Covered,
    /// By the order of serial numbers: the operator must look at its picture.
    InOrder,
}

/// An option --camera: `id` is the camera with this serial number, address, MAC or user-defined name.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Claim {
    /// Its name in the rig.
    pub id: CameraId,
    /// What it is known by.
    pub who: String,
}

/// A camera of the rig, the place of its answer among those that were found, and how that is known.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Role {
    /// Its name in the rig.
    pub id: CameraId,
    /// The number of its head.
    pub head: usize,
    /// Which of the answers is its.
    pub camera: usize,
    /// How it is known that it is this camera.
    pub known: Known,
}

/// Gives every camera of the rig (with the number of its head) one that answered: by the options --camera, by the
/// addresses of the node file, by the cameras' own names, the rest in the order of serial numbers.
///
/// # Errors
/// Everything that keeps the rig from having each of its cameras once.
pub fn assign(
    wanted: &[(CameraId, usize)],
    found: &[Found],
    claims: &[Claim],
    in_file: &[(CameraId, String)],
) -> Result<Vec<Role>, Vec<String>> {
    let mut problems = Vec::new();
    let mut roles: Vec<Role> = Vec::new();
    let mut take = |roles: &mut Vec<Role>, id: &CameraId, camera: usize, known: Known| {
        if let Some(other) = roles.iter().find(|role| role.camera == camera) {
            // The node file and the camera itself give way to the option; two options may not contradict each other.
            if known == Known::Said {
                let twice = format!("--camera: {} cannot be both {} and {id}", found[camera], other.id);
                problems.push(twice);
            }
        } else if let Some((_, head)) = wanted.iter().find(|(known, _)| known == id)
            && !roles.iter().any(|role| role.id == *id)
        {
            roles.push(Role { id: id.clone(), head: *head, camera, known });
        }
    };
    let mut unmet = Vec::new();
    for Claim { id, who } in claims {
        let meant: Vec<usize> = (0..found.len()).filter(|i| found[*i].is_known_as(who)).collect();
        match meant.as_slice() {
            _ if !wanted.iter().any(|(known, _)| known == id) => {
                let names: Vec<&str> = wanted.iter().map(|(known, _)| known.as_str()).collect();
                unmet.push(format!(
                    "--camera {id}={who}: expected a camera of this node in the rig: {}",
                    names.join(", ")
                ));
            }
            [camera] => take(&mut roles, id, *camera, Known::Said),
            [] => unmet.push(format!(
                "--camera {id}={who}: no camera with this serial number, address, MAC or name answers; check its \
                 power and cable"
            )),
            several => unmet.push(format!(
                "--camera {id}={who}: {} cameras are known by that; give the MAC or the address of one: {}",
                several.len(),
                found[several[0]]
            )),
        }
    }
    for (id, address) in in_file {
        if let Some(camera) = found.iter().position(|found| found.place == *address) {
            take(&mut roles, id, camera, Known::InFile);
        }
    }
    for (id, _) in wanted {
        let named: Vec<usize> = (0..found.len()).filter(|i| found[*i].user_name == id.as_str()).collect();
        if let [camera] = named.as_slice() {
            take(&mut roles, id, *camera, Known::ByUserName);
        }
    }
    problems.extend(unmet);
    let mut rest: Vec<usize> =
        (0..found.len()).filter(|i| !roles.iter().any(|role| role.camera == *i)).collect();
    rest.sort_by(|a, b| (&found[*a].serial, &found[*a].place).cmp(&(&found[*b].serial, &found[*b].place)));
    let open: Vec<&(CameraId, usize)> =
        wanted.iter().filter(|(id, _)| !roles.iter().any(|role| role.id == *id)).collect();
    if rest.len() > open.len() && !open.is_empty() {
        let all: Vec<String> = rest.iter().map(|camera| found[*camera].to_string()).collect();
        problems.push(format!(
            "{} cameras could be the {} that have no name yet ({}): name them with --camera, or leave others out with \
             --network",
            rest.len(),
            open.len(),
            all.join("; ")
        ));
    }
    for (id, _) in open.iter().skip(rest.len()) {
        problems.push(format!("no camera answers that could be {id}: check its power, cable and interface"));
    }
    if !problems.is_empty() {
        return Err(problems);
    }
    for ((id, head), camera) in open.into_iter().zip(rest) {
        roles.push(Role { id: id.clone(), head: *head, camera, known: Known::InOrder });
    }
    roles.sort_by_key(|role| wanted.iter().position(|(id, _)| *id == role.id));
    Ok(roles)
}

/// Puts each camera on the head whose pulse it answered (`heads`, a head a role; `None`: unknown). Those whose names
/// are known some other way must be there already; the others take the free names of their head, in order.
///
/// # Errors
/// A sentence for each camera that is wired to another head.
pub fn by_heads(roles: &[Role], heads: &[Option<usize>]) -> Result<Vec<Role>, Vec<String>> {
    let mut problems = Vec::new();
    let mut sorted = roles.to_vec();
    let free = |role: &Role| role.known == Known::InOrder;
    for (role, head) in roles.iter().zip(heads) {
        if let Some(head) = head.filter(|head| !free(role) && *head != role.head) {
            problems.push(format!(
                "{} takes its frames at the pulse of head number {head}, expected number {}: exchange the trigger \
                 wires, or correct --camera",
                role.id, role.head
            ));
        }
    }
    // Places in the list and the cameras that want one, head by head.
    let mut waiting: Vec<(usize, Option<usize>)> = roles
        .iter()
        .zip(heads)
        .filter(|(role, _)| free(role))
        .map(|(role, head)| (role.camera, *head))
        .collect();
    let places: Vec<usize> = (0..roles.len()).filter(|place| free(&roles[*place])).collect();
    let mut left = Vec::new();
    for place in places {
        match waiting.iter().position(|(_, head)| *head == Some(roles[place].head)) {
            Some(at) => sorted[place].camera = waiting.remove(at).0,
            None => left.push(place),
        }
    }
    for (place, (camera, head)) in left.into_iter().zip(waiting) {
        sorted[place].camera = camera;
        if let Some(head) = head {
            problems.push(format!(
                "head number {head} has more cameras on its wire than the rig, and {} has none: exchange trigger wires",
                roles[place].id
            ));
        }
    }
    if problems.is_empty() { Ok(sorted) } else { Err(problems) }
}

/// What the pictures of several cameras show while the operator covers the lens of one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Look {
    /// The picture of this one is dark, and no other's.
    Covered(usize),
    /// No picture is much darker than all others.
    NoneDark,
    /// This one sent no picture, so that nothing is known of the others either.
    NoPicture(usize),
}

/// Compares mean grey values with the brightest that each camera has shown so far, and notes brighter ones there.
pub fn covered(brightest: &mut [f64], now: &[Option<f64>]) -> Look {
    let mut share = Vec::with_capacity(now.len());
    for (place, (bright, grey)) in brightest.iter_mut().zip(now).enumerate() {
        let Some(grey) = *grey else { return Look::NoPicture(place) };
        *bright = bright.max(grey);
        share.push((grey + 1.0) / (*bright + 1.0));
    }
    let Some(darkest) = (0..share.len()).min_by(|a, b| share[*a].total_cmp(&share[*b])) else {
        return Look::NoneDark;
    };
    let others = share.iter().enumerate().filter(|(place, _)| *place != darkest).map(|(_, share)| *share);
    let next = others.min_by(f64::total_cmp).unwrap_or(1.0);
    match share[darkest] < 0.5 && share[darkest] < 0.6 * next {
        true => Look::Covered(darkest),
        false => Look::NoneDark,
    }
}

#[cfg(test)]
mod tests {
    use super::{Claim, Known, Look, Role, assign, by_heads, covered};
    use crate::base::ids::CameraId;
    use crate::network::Mac;
    use crate::new_bench::found::Found;

    fn answer(serial: &str, last: u8, user_name: &str) -> Found {
        Found {
            place: format!("192.168.10.{last}"),
            mac: Some(Mac(u64::from(last))),
            vendor: "Maker".to_owned(),
            model: "M1".to_owned(),
            serial: serial.to_owned(),
            user_name: user_name.to_owned(),
            interface: Some("cam0".to_owned()),
        }
    }

    fn wanted() -> Vec<(CameraId, usize)> {
        [("h0_up", 0), ("h0_low", 0), ("h1_up", 1)].map(|(id, head)| (CameraId::from(id), head)).into()
    }

    fn said(id: &str, who: &str) -> Claim {
        Claim { id: CameraId::from(id), who: who.to_owned() }
    }

    #[test]
    fn names_come_from_what_is_said_then_the_file_then_the_camera_then_the_order() {
        let found = [answer("30", 4, ""), answer("10", 5, "h0_up"), answer("20", 6, "")];
        let of = |roles: Vec<Role>| -> Vec<(usize, Known)> {
            roles.into_iter().map(|role| (role.camera, role.known)).collect()
        };
        let none = assign(&wanted(), &found, &[], &[]).expect("all there");
        assert_eq!(of(none), [(1, Known::ByUserName), (2, Known::InOrder), (0, Known::InOrder)]);
        let in_file = [(CameraId::from("h1_up"), "192.168.10.6".to_owned())];
        for who in ["30", "192.168.10.4", "00:00:00:00:00:04"] {
            let claims = [said("h0_up", who)];
            let roles = assign(&wanted(), &found, &claims, &in_file).expect("all there");
            assert_eq!(of(roles), [(0, Known::Said), (1, Known::InOrder), (2, Known::InFile)], "{who}");
        }
    }

    #[test]
    fn what_does_not_fit_is_told_all_at_once() {
        let found = [answer("10", 4, ""), answer("10", 5, "")];
        let claims = [said("h9", "10"), said("h0_up", "10"), said("h0_low", "77")];
        let problems = assign(&wanted(), &found, &claims, &[]).expect_err("wrong");
        let all = problems.join("\n");
        for part in ["h9=10: expected", "give the MAC or", "h0_low=77: no camera", "could be h1_up"] {
            assert!(all.contains(part), "{part:?} missing in {all}");
        }
        let four: Vec<Found> = (1..5).map(|n| answer(&n.to_string(), n, "")).collect();
        let problems = assign(&wanted(), &four, &[], &[]).expect_err("one too many");
        assert!(problems[0].contains("--network"), "{problems:?}");
    }

    #[test]
    fn cameras_go_to_the_head_whose_pulse_they_answer() {
        let role = |id: &str, head, camera, known| Role { id: CameraId::from(id), head, camera, known };
        let order = |id, head, camera| role(id, head, camera, Known::InOrder);
        let roles =
            [order("h0_up", 0, 0), order("h0_low", 0, 1), order("h1_up", 1, 2), order("h1_low", 1, 3)];
        let cameras = |heads: [Option<usize>; 4]| {
            by_heads(&roles, &heads).map(|roles| roles.iter().map(|role| role.camera).collect::<Vec<_>>())
        };
        assert_eq!(cameras([Some(1), Some(0), Some(1), Some(0)]), Ok(vec![1, 3, 0, 2]));
        assert_eq!(cameras([None; 4]), Ok(vec![0, 1, 2, 3]));
        assert!(cameras([Some(1), Some(1), Some(1), Some(0)]).is_err());
        let known = [role("h0_up", 0, 0, Known::Said), role("h1_up", 1, 1, Known::Said)];
        assert!(by_heads(&known, &[Some(0), Some(1)]).is_ok());
        let problems = by_heads(&known, &[Some(1), Some(0)]).expect_err("wires exchanged");
        assert_eq!(problems.len(), 2, "{problems:?}");
    }

    #[test]
    fn a_covered_lens_is_the_one_that_is_dark() {
        let look = |before: &[f64], now: &[f64]| {
            let now: Vec<Option<f64>> = now.iter().copied().map(Some).collect();
            covered(&mut before.to_vec(), &now)
        };
        assert_eq!(look(&[100.0, 120.0, 80.0], &[98.0, 4.0, 81.0]), Look::Covered(1));
        assert_eq!(look(&[100.0, 120.0], &[95.0, 110.0]), Look::NoneDark, "none is covered");
        assert_eq!(look(&[100.0, 120.0], &[5.0, 6.0]), Look::NoneDark, "the light is off");
    }

    #[test]
    fn a_picture_that_did_not_come_is_not_a_dark_one() {
        let mut brightest = [100.0, 120.0];
        assert_eq!(covered(&mut brightest, &[Some(98.0), None]), Look::NoPicture(1));
        // The one whose lens was covered, or whose light was off, at the first look is known when it was bright once.
        let mut brightest = [100.0, 3.0];
        assert_eq!(covered(&mut brightest, &[Some(98.0), Some(120.0)]), Look::NoneDark);
        assert_eq!(covered(&mut brightest, &[Some(98.0), Some(4.0)]), Look::Covered(1));
    }
}
