// Plays a CSV of t_s,force_N to tormagd: homes, enables, publishes each row as its time comes.
//
//   npm install                         brings zeromq and @msgpack/msgpack
//   node publish.js FOLDER PROFILE.csv  FOLDER holds the daemon's sockets: /run/tormag, say
import { readFile } from "node:fs/promises";
import { setTimeout as sleep } from "node:timers/promises";
import { decode, encode } from "@msgpack/msgpack";
import { Dealer, XPublisher } from "zeromq";

const PATIENCE_MS = 5_000; // for an answer of the daemon, and for its subscription
const ARMING_MS = 30_000; // homing takes some seconds
const VALID_FOR_MS = 500; // then the force decays: nobody renders what a dead publisher last said
const PASSES = ["busy", "not_homed", "not_fresh"]; // refusals that go away once homing is over

async function readProfile(path) {
  const [header, ...lines] = (await readFile(path, "utf8")).trim().split(/\r?\n/);
  if (header !== "t_s,force_N") throw new Error(`${path}: row 1 is '${header}', not t_s,force_N`);
  return lines.map((line) => line.split(",").map(Number));
}

async function received(socket, orElse) {
  try {
    return (await socket.receive()).at(-1);
  } catch (error) {
    throw error.code === "EAGAIN" ? new Error(orElse) : error;
  }
}

async function arm(control) {
  const until = Date.now() + ARMING_MS;
  let id = 0;
  for (const command of ["home", "enable"]) {
    for (;;) {
      await control.send(encode({ v: 1, id: ++id, command, args: {} }));
      const { ok, error } = decode(await received(control, "no answer: is the daemon running?"));
      if (ok) break;
      if (!PASSES.includes(error.code) || Date.now() > until) {
        throw new Error(`${command}: ${error.message}; ${error.hint}`);
      }
      await sleep(100);
    }
  }
}

async function play(setpoints, rows) {
  const startMs = Date.now();
  const startNs = BigInt(startMs) * 1_000_000n;
  let seq = 0;
  for (const [timeS, forceN] of rows) {
    const aheadMs = startMs + timeS * 1e3 - Date.now();
    if (aheadMs > 0) await sleep(aheadMs);
    const setpoint = {
      v: 1,
      source: "node",
      seq: seq++,
      session: startNs,
      stamp_ns: startNs + BigInt(Math.round(timeS * 1e9)), // when the force is meant, however late it is sent
      servo_cf: forceN,
      valid_for_ms: VALID_FOR_MS,
    };
    await setpoints.send(encode(setpoint, { useBigInt64: true }));
  }
  console.log(`published ${seq} setpoints, the first meant for ${startNs} ns since 1970`);
}

async function main(folder, path) {
  if (!path) throw new Error("usage: node publish.js FOLDER PROFILE.csv");
  const rows = await readProfile(path);
  const control = new Dealer({ linger: 0, receiveTimeout: PATIENCE_MS });
  control.connect(`ipc://${folder}/control`);
  await arm(control);

  // XPUB speaks to the daemon's SUB as PUB does, and is told of its subscription: what is sent earlier is lost
  const setpoints = new XPublisher({ linger: 200, receiveTimeout: PATIENCE_MS });
  setpoints.connect(`ipc://${folder}/setpoint`);
  await received(setpoints, `nobody takes setpoints in ${folder}`);
  await play(setpoints, rows);
  control.close();
  setpoints.close();
}

main(...process.argv.slice(2)).catch((error) => {
  console.error(error.message);
  process.exit(1);
});
