import assert from 'node:assert/strict';
import test from 'node:test';

import { load } from './modules.mjs';

const { daySpans, spanAt } = await load('point/day_spans.ts');
const { answer, casterText, clockOf, distanceText, intervalRows, lengthText, wind } = await load('point/words.ts');
const { placed, ring, runs, skyWords } = await load('point/polar_sky.ts');

const RIDGE = { kind: 'relief', distance_m: 2400, azimuth: 91, elevation: 3.12, height_m: 402, lon: 0, lat: 0 };
const TREES = { ...RIDGE, kind: 'forest', distance_m: 604, azimuth: 257, elevation: 17 };
const at = (clock) => `2024-09-22T${clock}-04:00`;
const DAY = {
  date: '2024-09-22', clock: 'UTC-04:00', sunrise: at('07:26:20'), sunset: at('19:31:21'), noon: at('13:28:57'), noon_altitude: 53.7,
  first_sun: at('07:39:49'), last_sun: at('18:03:59'), daylight_h: 12.08, direct_h: 9.4, masked_h: 2.7, remark: null,
  sunlit: [
    { begin: at('07:39:49'), end: at('12:00:00'), after: RIDGE, before: TREES },
    { begin: at('13:00:00'), end: at('18:03:59'), after: TREES, before: RIDGE },
  ],
};
const report = (day, now = null) => ({ level: 'l', lon: 0, lat: 0, elevation_m: 300, height_m: 0, now, day, remark: null });
const told = ({ sentences }) => sentences.map((parts) => parts.map((part) => (typeof part === 'string' ? part : clockOf(part.instant))).join('')).join(' ');

test('a day is spans without gaps, each with what the service says of it', () => {
  const spans = daySpans(DAY, '-04:00');
  assert.deepEqual(spans.map(({ light }) => light), ['night', 'shadow', 'lit', 'shadow', 'lit', 'shadow', 'night']);
  assert.equal(spans[0].begin, 0);
  assert.equal(spans.at(-1).end, 1440);
  for (const [index, { begin }] of spans.slice(1).entries()) assert.equal(begin, spans[index].end);
  assert.deepEqual(spans.filter(({ light }) => light === 'shadow').map(({ by }) => by), [RIDGE, TREES, RIDGE]);
  assert.equal(spans[2].beginsAt, DAY.sunlit[0].begin);
  assert.equal(spanAt(spans, 12 * 60 + 30).light, 'shadow');
});

test('a plain has neither shadow in the morning nor in the evening', () => {
  const whole = { ...DAY, sunlit: [{ begin: DAY.sunrise, end: DAY.sunset, after: null, before: null }] };
  assert.deepEqual(daySpans(whole, '-04:00').map(({ light }) => light), ['night', 'lit', 'night']);
  assert.equal(told(answer(report(whole), 720, '-04:00')), 'Since 07:26, since it rose. Until 19:31, when it sets.');
});

test('polar night is night, polar day is sun, and by a far clock the day begins and ends with it', () => {
  const none = { ...DAY, sunrise: null, sunset: null, sunlit: [], daylight_h: 0, remark: 'polar night: no sun' };
  assert.deepEqual(daySpans(none, '-04:00').map(({ light }) => light), ['night']);
  assert.equal(told(answer(report(none), 720, '-04:00')), 'Polar night: no sun.');
  const all = { ...none, daylight_h: 24, sunlit: [{ begin: at('00:00:00'), end: '2024-09-23T00:00:00-04:00', after: null, before: null }] };
  assert.deepEqual(daySpans(all, '-04:00').map(({ light, begin, end }) => [light, begin, end]), [['lit', 0, 1440]]);
  const far = { ...DAY, sunrise: at('14:00:00'), sunset: at('02:00:00'), sunlit: [] };
  assert.deepEqual(daySpans(far, '-04:00').map(({ light }) => light), ['shadow', 'night', 'shadow']);
});

test('the answer says lit or in shadow, since when, until when, by what', () => {
  assert.equal(told(answer(report(DAY), 9 * 60, '-04:00')),
    'Since 07:39, when it cleared a ridge 2.4 km to the east, 3.1° high. Until 12:00, when it goes behind trees 604 m to the west-southwest, 17.0° high.');
  assert.equal(told(answer(report(DAY), 12.5 * 60, '-04:00')), 'Of trees 604 m to the west-southwest, 17.0° high. Since 12:00. Until 13:00.');
  assert.equal(told(answer(report(DAY), 19 * 60, '-04:00')),
    'Of a ridge 2.4 km to the east, 3.1° high. Since 18:03. Until 19:31, when the sun sets: no more sun today.');
  assert.equal(told(answer(report(DAY), 60, '-04:00')), 'Until 07:26. The first sun here comes at 07:39.');
  assert.equal(answer(report(DAY), 1400, '-04:00').title, 'The sun is down');
  assert.equal(answer(report(null), 60, '-04:00'), null);
});

test('what hides the sun at the very moment goes before what hides it at the interval’s ends', () => {
  const now = { time: at('12:30:00'), azimuth: 160, altitude: 50, lit: false, by: { ...RIDGE, kind: 'building', distance_m: 5.25 } };
  assert.match(told(answer(report(DAY, now), 12.5 * 60, '-04:00')), /^Of a building 5\.3 m to the east/);
  assert.match(told(answer(report(DAY, now), 12.6 * 60, '-04:00')), /^Of trees/);
});

test('numbers in words', () => {
  assert.deepEqual([5.25, 604, 2400, 31_400].map(distanceText), ['5.3 m', '604 m', '2.4 km', '31 km']);
  assert.deepEqual([0, 359, 90, 257, -90].map(wind), ['north', 'north', 'east', 'west-southwest', 'west']);
  assert.deepEqual([0.2, 60, 624].map(lengthText), ['0 min', '1 h', '10 h 24 min']);
  assert.equal(intervalRows(DAY)[0].length, '4 h 20 min');
  assert.match(casterText(TREES), /^trees 604 m/);
});

test('the sky is drawn with north up and east to the right', () => {
  const near = (one, other) => one.forEach((value, n) => assert.ok(Math.abs(value - other[n]) < 1e-9, `${one} ${other}`));
  near(placed({ azimuth: 0, altitude: 0 }), [0, -100]);
  near(placed({ azimuth: 90, altitude: 45 }), [50, 0]);
  near(placed({ azimuth: 180, altitude: 90 }), [0, 0]);
  assert.match(ring([0, 90, 180, 270], [0, 45, 0, 0]), /M-?0\.00 -100\.00L50\.00 -?0\.00L/);
  const path = [[8, true], [8.0833, true], [8.1667, false], [15, false]].map(([hour, lit]) => ({
    time: new Date(hour * 3_600_000).toISOString(), azimuth: hour * 15, altitude: 10, lit,
  }));
  assert.deepEqual(runs(path).map(({ lit, points }) => [lit, points.length]), [[true, 3], [false, 1], [false, 1]]);
  const horizon = { azimuth: [0, 90, 180, 270], relief: [1, 2, 0, 0], solids: [0, 0, 0, 12.34], forest: [0, 0, 0, 0] };
  assert.equal(skyWords({ date: '', horizon, path }), 'Horizon: highest in the west with 12.3°. The sun climbs to 10.0°.');
});
