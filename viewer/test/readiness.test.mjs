import assert from 'node:assert/strict';
import test from 'node:test';

import { load } from './modules.mjs';

const { ReadinessPoll, pauseAfter, readinessOf } = await load('readiness.ts');
const { ProgressWatch, elapsedText, leftText } = await load('time_left.ts');

const TILES = { task: 'compiling loops for map tiles', done: 57, total: 180, elapsed: null };

test('readiness is what the service says', () => {
  assert.deepEqual(readinessOf(503, { status: 503, preparing: TILES }), { phase: 'starting', preparing: TILES, calibration: null });
  assert.deepEqual(readinessOf(503, { status: 503 }), { phase: 'starting', preparing: null, calibration: null });
  assert.deepEqual(readinessOf(200, { status: 'ready', preparing: TILES }), { phase: 'ready', preparing: TILES, calibration: null });
  assert.deepEqual(readinessOf(200, { status: 'ready', preparing: null, calibration: 'running' }), { phase: 'ready', preparing: null, calibration: 'running' });
  const since = readinessOf(503, { preparing: { ...TILES, elapsed_s: 95.5 } }).preparing;
  assert.deepEqual({ ...since, elapsed_s: undefined }, { ...TILES, elapsed: 95.5, elapsed_s: undefined });
});

test('a proxy without its service is unreachable, and a hidden address is no obstacle', () => {
  for (const status of [502, 503, 504]) assert.equal(readinessOf(status, null).phase, 'unreachable', String(status));
  for (const status of [200, 403, 404]) assert.deepEqual(readinessOf(status, null), { phase: 'ready', preparing: null, calibration: null }, String(status));
});

test('a preparation that means nothing is none, and counts stay within the total', () => {
  for (const preparing of ['soon', 1, {}, { task: '', done: 1, total: 2 }, { done: 1, total: 2 }]) {
    assert.equal(readinessOf(503, { preparing }).preparing, null, JSON.stringify(preparing));
  }
  assert.deepEqual(readinessOf(503, { preparing: { ...TILES, done: 200 } }).preparing, { ...TILES, done: 180 });
  assert.deepEqual(readinessOf(503, { preparing: { ...TILES, done: null, total: null } }).preparing, { ...TILES, done: 0, total: 0 });
});

test('the poll is fast at the start, slow in the background, backs off, and ends', () => {
  assert.equal(pauseAfter({ phase: 'starting', preparing: null }, 0), 500);
  assert.equal(pauseAfter({ phase: 'ready', preparing: TILES }, 0), 2000);
  assert.equal(pauseAfter({ phase: 'ready', preparing: null }, 0), null);
  assert.deepEqual([1, 2, 3, 4, 50].map((failures) => pauseAfter({ phase: 'unreachable', preparing: null }, failures)), [1000, 2000, 4000, 8000, 8000]);
});

test('who waits for readiness goes on with it, or is aborted', { timeout: 10_000 }, async (context) => {
  const answers = [[503, { preparing: TILES }], [200, { preparing: null }]];
  const { mock } = context.mock.method(globalThis, 'fetch', async () => {
    const [status, body] = answers.shift() ?? [200, null];
    return { status, json: async () => body };
  });
  context.mock.timers.enable({ apis: ['setTimeout'] });
  const poll = new ReadinessPoll('http://service/readyz');
  const leaving = new AbortController();
  const gone = assert.rejects(poll.until(['ready'], leaving.signal), { name: 'AbortError' });
  await assert.rejects(poll.until(['ready'], AbortSignal.abort()), { name: 'AbortError' });
  const waiting = poll.until(['ready']);
  assert.equal((await poll.check()).phase, 'starting');
  leaving.abort();
  await gone;
  context.mock.timers.tick(500);
  await waiting;
  assert.equal(poll.current.phase, 'ready');
  await poll.until(['ready']);
  context.mock.timers.tick(60_000);
  assert.equal(mock.callCount(), 2, 'and then no more is asked');
});

test('time left follows from the progress that was seen', () => {
  const watch = new ProgressWatch();
  const see = (done, now, task = TILES.task) => watch.see({ task, done, total: 180 }, now);
  see(30, 100);
  see(40, 104);
  assert.equal(watch.secondsLeft(104), null, 'too little has been seen');
  see(60, 110);
  assert.equal(watch.secondsLeft(110), 40, 'three a second were done since the page looks on, and 120 are left');
  assert.equal(watch.secondsLeft(112), 48, 'a step that takes long makes the others slower');
  assert.equal(watch.secondsLeft(126), null, 'too long to tell');
  see(90, 130);
  assert.equal(watch.secondsLeft(130), 45);
  see(90, 131, 'compiling loops for hours of sun');
  assert.equal(watch.secondsLeft(140), null, 'another task begins anew');
  see(100, 150, 'compiling loops for hours of sun');
  see(2, 152, 'compiling loops for hours of sun');
  see(12, 156, 'compiling loops for hours of sun');
  assert.equal(watch.secondsLeft(160), null, 'less than before begins anew');
  watch.see({ task: 'starting a render process', done: 0, total: 0 }, 200);
  assert.equal(watch.secondsLeft(220), null, 'of an unknown total nothing is told');
});

test('what does not move for long is stalled', () => {
  const watch = new ProgressWatch();
  assert.equal(watch.isStalled(1e6), false);
  watch.see(TILES, 10);
  watch.see(TILES, 100);
  assert.equal(watch.isStalled(100), false);
  assert.equal(watch.isStalled(101), true);
  watch.see({ ...TILES, done: 58 }, 102);
  assert.equal(watch.isStalled(103), false);
});

test('times in words', () => {
  assert.deepEqual([0.4, 59.9, 60, 125].map(elapsedText), ['0 s', '59 s', '1 min 0 s', '2 min 5 s']);
  assert.deepEqual([0, 7, 8, 31, 55, 56, 61, 190].map(leftText), [
    'a few seconds left', 'a few seconds left', 'about 10 s left', 'about 35 s left', 'about 55 s left', 'about 1 min left', 'about 2 min left', 'about 4 min left',
  ]);
});
