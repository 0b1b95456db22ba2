// SPDX-License-Identifier: MIT OR Apache-2.0
//! The job scripts: readable, and fit to be edited and submitted by hand.

use super::job::{Job, folder};
use crate::base::write_whole;
use std::io::Write;
use std::path::Path;

/// How many times a task that has failed is started again.
const RETRIES: u32 = 3;

/// Seconds before the limit of time at which Slurm sends a task the signal to end: a frame set takes less.
const NOTICE_S: u32 = 60;

/// Minutes that the collecting job may take in any case.
const COLLECT_MIN: u64 = 30;
/// Seconds that the collecting job may take for each frame set, of which it reads and writes 60 MB.
const COLLECT_S: u64 = 2;

/// Text as one word of a shell.
fn quoted(text: &str) -> String {
    let plain = |c: char| c.is_ascii_alphanumeric() || "-_./=,:@%+".contains(c);
    if !text.is_empty() && text.chars().all(plain) {
        return text.to_owned();
    }
    format!("'{}'", text.replace('\'', r"'\''"))
}

fn quoted_path(path: &Path) -> String {
    quoted(&path.to_string_lossy())
}

/// The options of `sbatch` that both scripts share.
fn header(job: &Job, name: &str, about: &str) -> String {
    let mut text = format!(
        "#!/bin/bash\n# fourdbody: {about}\n# Written by `fourdbody cluster submit`. It may be edited and submitted by hand, from the directory\n\
         # that it is in: sbatch {name}.sh\n"
    );
    let session = job.work.session.file_name().unwrap_or_default().to_string_lossy();
    let session: String = session.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '-' }).collect();
    let mut option = |option: &str| text += &format!("#SBATCH {option}\n");
    option(&format!("--job-name=fourdbody-{name}-{session}"));
    option("--nodes=1 --ntasks=1");
    option(&format!("--cpus-per-task={}", job.sizing.cpus));
    option(&format!("--mem={}M", job.sizing.memory_mib));
    option("--requeue");
    option("--open-mode=append");
    job.sbatch.iter().for_each(|further| option(further));
    text
}

/// The command that both scripts share, up to what is special to each.
fn command(job: &Job) -> String {
    let calibration = folder(&job.work.out).join("calibration.json");
    let options: Vec<String> = job.work.options.iter().map(|option| quoted(option)).collect();
    let out = job.work.store.as_ref().map_or_else(|| quoted_path(&job.work.out), |store| quoted(store));
    format!(
        "{} reconstruct {} \\\n    --calibration {} \\\n    --out {out} \\\n    {}",
        quoted_path(&job.work.program),
        quoted_path(&job.work.session),
        quoted_path(&calibration),
        options.join(" "),
    )
}

/// The lines before the command, which runs in the background so that the script can handle signals.
const NOTICE: &str = r#"# Slurm signals that the time is nearly over: end. What is finished stays, the next start goes on there. (TERM is what
# `scancel` sends, and ends this script.)
trap 'kill "$!"' USR1
"#;

/// The end of a script, which handles the exit code of its command: what may succeed at another time is tried again.
/// `own`: the name of this task for Slurm. (The number of an array's last task is also that of the array.)
fn ending(own: &str) -> String {
    format!(
        r#" &
wait "$!"
code=$?
case $code in
    # 3 and 4: done; frames that are missing or damaged are listed in the summary.
    0 | 3 | 4) exit 0 ;;
    # Wrong usage or configuration: it would be the same again.
    2) exit 2 ;;
esac
if [ "${{SLURM_RESTART_COUNT:-0}}" -lt {RETRIES} ]; then
    echo "fourdbody: exit code $code; once more"
    # Slurm ends this script when it puts it back.
    scontrol requeue "{own}" && sleep 300
fi
exit "$code"
"#
    )
}

/// Numbers as Slurm writes them: `0-3,7`.
fn ranges(numbers: &[u64]) -> String {
    let mut runs: Vec<(u64, u64)> = Vec::new();
    for &number in numbers {
        match runs.last_mut() {
            Some((_, last)) if *last + 1 == number => *last = number,
            _ => runs.push((number, number)),
        }
    }
    let run = |(first, last): (u64, u64)| {
        if first == last { first.to_string() } else { format!("{first}-{last}") }
    };
    runs.into_iter().map(run).collect::<Vec<_>>().join(",")
}

/// The script of the job array: one task a shard.
pub fn shards_script(job: &Job) -> String {
    let mut text = header(job, "shards", "the shards of a session, one task each");
    let at_once = job.at_once.map_or_else(String::new, |n| format!("%{n}"));
    text += &format!("#SBATCH --array={}{at_once}\n", ranges(&job.array));
    text += &format!("#SBATCH --time={}\n", job.sizing.limit_min);
    text += &format!("#SBATCH --signal=B:USR1@{NOTICE_S}\n#SBATCH --output=log/shard-%a.log\n\n");
    text += "echo \"shard $SLURM_ARRAY_TASK_ID on $(hostname), start $((${SLURM_RESTART_COUNT:-0} + 1))\"\n";
    text += NOTICE;
    text += &command(job);
    text += &format!(" \\\n    --shard \"$SLURM_ARRAY_TASK_ID/{}\" --jobs {}", job.shards, job.sizing.cpus);
    text + &ending("${SLURM_ARRAY_JOB_ID}_$SLURM_ARRAY_TASK_ID")
}

/// The script of the job that makes one result of all shards.
pub fn collect_script(job: &Job) -> String {
    let mut text =
        header(job, "collect", "one result of all shards; to be submitted with --dependency=afterok:ARRAY");
    text += "#SBATCH --kill-on-invalid-dep=yes\n";
    let frame_sets = job.work.triggers[1].saturating_sub(job.work.triggers[0]);
    text += &format!("#SBATCH --time={}\n", COLLECT_MIN + frame_sets.saturating_mul(COLLECT_S) / 60);
    text += "#SBATCH --output=log/collect.log\n\n";
    text += NOTICE;
    text += &command(job);
    text += &format!(" \\\n    --collect {} --jobs {}", job.shards, job.sizing.cpus);
    text + &ending("$SLURM_JOB_ID")
}

/// Writes both scripts, and the directory of the logs that they name.
pub fn write_scripts(job: &Job) -> Result<(), String> {
    let folder = folder(&job.work.out);
    let logs = folder.join("log");
    std::fs::create_dir_all(&logs).map_err(|e| format!("{}: {e}", logs.display()))?;
    for (name, text) in [("shards.sh", shards_script(job)), ("collect.sh", collect_script(job))] {
        let path = folder.join(name);
        write_whole(&path, |file| file.write_all(text.as_bytes()))
            .map_err(|e| format!("{}: {e}", path.display()))?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::{quoted, ranges};
    use proptest::prelude::{prop_assert_eq, proptest};
    use std::process::Command;

    #[test]
    fn arrays_are_written_short() {
        assert_eq!(ranges(&[0, 1, 2, 3, 7, 9, 10]), "0-3,7,9-10");
        assert_eq!(ranges(&[]), "");
    }

    proptest! {
        #![proptest_config(proptest::prelude::ProptestConfig::with_cases(40))]
        #[test]
        fn a_shell_reads_what_was_quoted(text in "[^\0\r]{0,20}") {
            let script = format!("printf %s {}", quoted(&text));
            let output = Command::new("bash").arg("-c").arg(script).output().expect("bash runs");
            prop_assert_eq!(String::from_utf8_lossy(&output.stdout), text);
        }
    }
}
