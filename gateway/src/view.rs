//! `gateway view`, and the option `--view` of runs.

use std::collections::BTreeMap;
use std::ffi::{OsStr, OsString};
use std::io;
use std::net::{IpAddr, Ipv4Addr, SocketAddr, TcpListener};
use std::os::fd::AsFd;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};

use bench::remote::Lines;
use bench::run;
use clap::Args;
use cover::mesh::{Triangle, simplify};
use protocol::bus::Kinds;
use protocol::skin::Skin;
use protocol::usage::Failure;
use robots::Isometry3;
use trace::capture::{CaptureError, Format, Reader};
use view::Shell;
use view::play::{self, play};
use view::player::PlayError;
use view::serve::{Options, ServeError, serve};
use view::server::Access;

use super::arguments::{BusKinds, bus_names, bus_of, nanos};
use super::input::{no_frame, read_skin, remark_another, skin_for, skin_of, stopped};
use super::output::note;
use super::surface::{Placed, Surface};
use super::visuals::Packages;

/// The most triangles of a robot that a page draws; more are simplified.
const TRIANGLES: usize = 20_000;

/// Where a page is served unless it is told.
const LISTEN: SocketAddr = SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 0);

/// Show a skin in a browser, live or recorded, and press its cells with the mouse
///
/// Listens to the buses of a bench or of a robot, and serves one page that draws the arm and its cells: coloured by force,
/// proximity or temperature, their state by their shape, each joint's torque beside the central computation. A click presses
/// a cell with a stimulus, if it is in test mode. Of a recording the same page plays, scrubs, steps by epoch, and goes to
/// the next touch, loss, silent cell or halt. The page needs no network but this server, which only answers this machine,
/// unless --listen names another address; then each request needs the --token. If the skin has robot.urdf, the robot is
/// drawn by its meshes, as far as they are found. It ends with Ctrl-C.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  gateway demo --view
  gateway view gateway/examples/ur5-253.toml --bus-kind embedded
  gateway view can1 --skin humanoid.toml
  gateway view run.mcap run-*.mcap --at 12.5
  gateway view run.log --skin skin.toml
  gateway view skin.toml --listen 0.0.0.0:8100 --token $(openssl rand -hex 16) --read-only")]
pub(crate) struct View {
    /// A skin's description, whose buses are listened to; or some of its buses, with --skin; or a candump log or MCAP
    /// recording, or all parts of a split one in any order
    #[arg(required = true, value_name = "SKIN|BUS|FILE")]
    sources: Vec<PathBuf>,
    /// The skin of buses that are named, or of a recording; without it a recording's is the one in it
    #[arg(long, value_name = "SKIN")]
    skin: Option<PathBuf>,
    /// Stay at so many seconds after the first frame of a recording, instead of playing it
    #[arg(long, value_name = "S", value_parser = nanos)]
    at: Option<u64>,
    /// The address of the page; port 0 is any that is free
    #[arg(long, value_name = "ADDRESS:PORT", default_value_t = LISTEN)]
    listen: SocketAddr,
    /// What every request has to carry as ?token=; at least 16 letters or digits
    #[arg(long, value_name = "TOKEN", value_parser = token)]
    token: Option<String>,
    /// Let pages look, but not press, halt or resume
    #[arg(long)]
    read_only: bool,
    /// Wait for buses that are not there yet
    #[arg(long)]
    wait: bool,
    /// Belong to the run that has started it: take its state from standard input, write commands to standard output, end with it
    #[arg(long, hide = true)]
    of_run: bool,
    /// Listen to the buses of a recording's skin, to which it is replayed
    #[arg(long, hide = true)]
    replayed: bool,
    #[command(flatten)]
    packages: Packages,
    #[command(flatten)]
    kinds: BusKinds,
}

fn token(text: &str) -> Result<String, String> {
    let is_plain = text.bytes().all(|byte| byte.is_ascii_alphanumeric());
    if text.len() < 16 || !is_plain {
        return Err("a token has at least 16 letters or digits".to_owned());
    }
    Ok(text.to_owned())
}

impl View {
    pub(crate) fn run(self) -> Result<(), Failure> {
        if !self.listen.ip().is_loopback() && self.token.is_none() {
            return Err(Failure::usage(format!(
                "--listen {}: others than this machine may come there: give a --token, or listen on 127.0.0.1",
                self.listen
            )));
        }
        let is_recording = !self.replayed && self.is_recording()?;
        let access = Access {
            listen: self.listen,
            may_act: !self.read_only && !is_recording,
            may_play: is_recording,
            token: self.token.clone(),
        };
        let says = |url: &str| note(format_args!("view: {url}"));
        if is_recording { self.recorded(access, says) } else { self.live(access, says) }
    }

    /// The skin of buses.
    fn live(self, access: Access, says: impl FnOnce(&str)) -> Result<(), Failure> {
        let (skin, surface) = match self.sources.as_slice() {
            _ if self.replayed => self.recorded_skin()?,
            [one, ..] if !one.exists() => self.on_buses()?,
            [one] if self.skin.is_none() && self.at.is_none() => self.read(one)?,
            [one] => {
                let why = "is of a recording, and this is a skin, whose buses are listened to";
                return Err(Failure::usage(format!("{}: --skin or --at {why}", one.display())));
            }
            _ => {
                let why = "several files are the parts of one recording, and a skin is shown alone";
                return Err(Failure::usage(why));
            }
        };
        let kinds = self.kinds.of(bus_names(&skin))?;
        let stop = stopped()?;
        let bench = self.of_run.then(run_of_this).transpose().map_err(|error| failed(&error))?;
        let options = Options { skin, surface, kinds, directory: None, access, patient: self.wait, bench };
        serve(options, &stop, says).map_err(Failure::usage)?;
        Ok(())
    }

    /// The part of a skin on the buses that are named.
    fn on_buses(&self) -> Result<(Skin, Vec<Shell>), Failure> {
        let Some(file) = &self.skin else {
            let name = self.sources.first().map(|it| it.display().to_string()).unwrap_or_default();
            return Err(Failure::usage(format!(
                "there is no file {name}: name a skin, whose buses are listened to, a recording, or a bus and its --skin"
            )));
        };
        if self.at.is_some() {
            return Err(Failure::usage("--at is of a recording, and buses are listened to"));
        }
        let (skin, surface) = self.read(file)?;
        let of = |source: &PathBuf| bus_of(&skin, &file.display().to_string(), &source.to_string_lossy());
        let mut buses = self.sources.iter().map(of).collect::<Result<Vec<_>, _>>()?;
        buses.sort_unstable();
        buses.dedup();
        Ok((skin.on_buses(&buses), surface))
    }

    /// A recording.
    fn recorded(self, access: Access, says: impl FnOnce(&str)) -> Result<(), Failure> {
        let (skin, surface) = self.recorded_skin()?;
        #[expect(clippy::cast_precision_loss, reason = "to the µs")]
        let at_s = self.at.map(|nanos| nanos as f64 / 1e9);
        let stop = stopped()?;
        let warns = |what: &str| note(format_args!("{what}"));
        let options = play::Options { paths: self.sources, skin, surface, access, at_s };
        play(options, &stop, says, warns).map_err(|error| match error {
            ServeError::Play(PlayError::Damaged(_) | PlayError::Capture(CaptureError::Damaged { .. })) => {
                Failure::run(error)
            }
            ServeError::Bus(_) | ServeError::Play(_) | ServeError::Thread(_) | ServeError::Listen { .. } => {
                Failure::usage(error)
            }
        })?;
        Ok(())
    }

    /// The skin in a file, and its robot by its meshes, as far as they are found.
    fn read(&self, path: &Path) -> Result<(Skin, Vec<Shell>), Failure> {
        let skin = read_skin(path)?;
        let surface = Surface::read(path, &skin, &self.packages).map(|it| simplified(&it));
        Ok((skin, surface.unwrap_or_default()))
    }

    /// The skin of a recording; of the one in it the URDF is not beside it.
    fn recorded_skin(&self) -> Result<(Skin, Vec<Shell>), Failure> {
        match &self.skin {
            Some(path) => {
                let (skin, shells) = self.read(path)?;
                remark_another(&self.sources, path, &skin);
                Ok((skin, shells))
            }
            None => {
                let skin = skin_of(&self.sources)?;
                if skin.robot.urdf.is_some() {
                    note(
                        "the recording does not have the robot's meshes: with the --skin beside its URDF they are shown",
                    );
                }
                Ok((skin, Vec::new()))
            }
        }
    }

    /// Whether it is a recording, by what is in it, and not a skin.
    fn is_recording(&self) -> Result<bool, Failure> {
        let Some(first) = self.sources.first() else { return Ok(false) };
        if !first.exists() {
            return Ok(false);
        }
        if first.metadata().is_ok_and(|about| !about.is_file()) {
            let what = "is no regular file: name a skin, whose buses are listened to, or a recording";
            return Err(Failure::usage(format!("{} {what}", first.display())));
        }
        let mut reader = Reader::open(first).map_err(Failure::usage)?;
        if reader.format() == Format::Mcap || reader.has_frame().map_err(Failure::usage)? {
            return Ok(true);
        }
        // What is to be shown with a skin of its own, or of which a moment is, is no skin.
        if (self.skin.is_some() || self.at.is_some()) && Skin::read(first).is_err() {
            return Err(no_frame(&reader));
        }
        Ok(false)
    }
}

/// What a page draws of a robot: for each row its triangles.
fn simplified(surface: &Surface) -> Vec<Shell> {
    let mut rows = BTreeMap::<_, Vec<_>>::new();
    for Placed { chain, row, part } in &surface.parts {
        rows.entry((*chain, *row)).or_default().extend(part.triangles(&Isometry3::identity()));
    }
    let (places, triangles): (Vec<_>, Vec<_>) = rows.into_iter().unzip();
    let shells = places.into_iter().zip(simplify(triangles, TRIANGLES));
    let point = |triangles: Vec<Triangle>| {
        triangles.into_iter().map(|triangle| triangle.map(|corner| corner.coords.into())).collect()
    };
    shells.map(|((chain, row), all)| Shell { chain, row, triangles: point(all) }).collect()
}

/// The run that has started this program, at its standard input and output.
fn run_of_this() -> io::Result<Lines> {
    Lines::new(io::stdin().as_fd().try_clone_to_owned()?, io::stdout().as_fd().try_clone_to_owned()?)
}

fn failed(error: &io::Error) -> Failure {
    Failure::run(format!("--view: {error}"))
}

/// The page of a run, in a process of its own; it ends with this value.
#[derive(Debug)]
pub(crate) struct Page(Child);

impl Page {
    /// Serves the page of a run, whose buses open later; and where it sends what pages want of the run.
    pub(crate) fn of(run: &run::Options, listen: Option<SocketAddr>) -> Result<(Self, Lines), Failure> {
        let run::Options { skin_file, skin, kinds, directory, .. } = run;
        Self::start([skin_file.as_os_str()], skin, kinds, directory.as_deref(), listen)
    }

    /// Serves the page of a replay, which cannot be commanded.
    pub(crate) fn of_replay(
        files: &[PathBuf],
        skin: Option<&Path>,
        kinds: &Kinds,
        listen: Option<SocketAddr>,
    ) -> Result<(Self, Lines), Failure> {
        let known = skin_for(files, skin)?;
        let given = skin.into_iter().flat_map(|path| [OsStr::new("--skin"), path.as_os_str()]);
        let words = ["--replayed", "--read-only"].map(OsStr::new).into_iter().chain(given);
        Self::start(words.chain(files.iter().map(|file| file.as_os_str())), &known, kinds, None, listen)
    }

    fn start<'a>(
        words: impl IntoIterator<Item = &'a OsStr>,
        skin: &Skin,
        kinds: &Kinds,
        directory: Option<&Path>,
        listen: Option<SocketAddr>,
    ) -> Result<(Self, Lines), Failure> {
        let program = std::env::current_exe().map_err(|error| failed(&error))?;
        let mut command = Command::new(program);
        command.args(["view", "--wait", "--of-run"]).args(words);
        for bus in &skin.buses {
            let kind = kinds.of(&bus.name).resolve();
            command.arg("--bus-kind").arg(OsString::from(format!("{}={kind}", bus.name)));
        }
        if let Some(listen) = listen {
            // Its own refusal would come when the run has begun.
            TcpListener::bind(listen).map_err(|error| {
                Failure::usage(format!(
                    "--view={listen}: {error}; name another port, or --view alone for a free one"
                ))
            })?;
            command.arg("--listen").arg(listen.to_string());
        }
        if let Some(directory) = directory {
            command.env("SKINBUS_DIR", directory);
        }
        // Its signals are its own: the run ends it, also on Ctrl-C.
        command.process_group(0);
        let child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn();
        let mut page = child.map(Self).map_err(|error| failed(&error))?;
        let (Some(commands), Some(state)) = (page.0.stdout.take(), page.0.stdin.take()) else {
            return Err(Failure::run("--view: no pipes"));
        };
        let lines = Lines::new(commands, state).map_err(|error| failed(&error))?;
        Ok((page, lines))
    }

    /// How its process has ended, if it has.
    pub(crate) fn ended(&mut self) -> Option<ExitStatus> {
        self.0.try_wait().ok().flatten()
    }
}

impl Drop for Page {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}
