import assert from 'node:assert/strict';
import test from 'node:test';

import { load } from './modules.mjs';

const { addressFaults, readAddress, writeAddress } = await load('address.ts');
const { FIRST_STATE } = await load('state.ts');
const { formatMoment, isDate, offsetAt, offsetIn, onDate, parseMoment } = await load('moments.ts');
const { openingMoment } = await load('opening.ts');
const { sunAt } = await load('sun_day.ts');
const { waitText } = await load('day_wait.ts');
const { sunQuery } = await load('query.ts');

const PANELS = ['map', 'point', 'compare'];

test('what an address has and means nothing is told of, part by part', () => {
  const wrong = [
    'time=yesterday', 'time=2024-02-30T10:00:00Z', 'time=2024-06-21T25:00:00Z', 'time=2024-06-21T10:00:00', 'azimuth=west', 'azimuth=361', 'altitude=91',
    'layer=Re-lief!', 'quantity=all', 'opacity=2', 'solid=yes', 'theme=blue', 'map=here', 'map=9/99/0', 'tiem=1', 'time', 'style=%E0%A4%A',
  ];
  for (const part of wrong) {
    const faults = addressFaults(`#level=hills&${part}`, PANELS);
    assert.equal(faults.length, 1, `${part}: ${faults}`);
    assert.ok(faults[0].includes(part.split('=')[0]), faults[0]);
  }
  assert.equal(addressFaults(`#${wrong.slice(4, 8).join('&')}`, PANELS).length, 3, 'the later of two of a name counts');
});

test('what is right is not told of, nor what the page itself writes', () => {
  const right = '#level=hills&layer=shadow&time=2024-06-21T10:00:00%2B02:00&solid=1&map=9/47/8/0/0&point=8,47&point-height=2&compare=time:09:00';
  assert.deepEqual(addressFaults(right, PANELS), []);
  assert.deepEqual(addressFaults('', PANELS), []);
  const state = { ...FIRST_STATE, level: 'hills', layer: 'sunhours', quantity: 'first', theme: 'dark', opacity: 0.5, own: { point: '8,47' } };
  const view = { zoom: 9, lat: 47, lon: 8, bearing: 10, pitch: 30 };
  for (const sunBy of ['time', 'angles', 'none']) {
    const written = writeAddress({ ...state, sunBy, view, shot: 'main' });
    assert.deepEqual(addressFaults(written, PANELS), [], written);
    assert.equal(readAddress(written).sunBy ?? 'none', sunBy);
  }
  assert.deepEqual(sunQuery({ ...state, sunBy: 'none' }), {}, 'lamps alone');
});

test('a clock is that of the place, winter and summer', () => {
  assert.equal(offsetIn('Europe/Zurich', new Date('2026-01-15T12:00:00Z')), '+01:00');
  assert.equal(offsetIn('Europe/Zurich', new Date('2026-07-15T12:00:00Z')), '+02:00');
  assert.equal(offsetIn('Asia/Kathmandu', new Date('2026-07-15T12:00:00Z')), '+05:45');
  assert.equal(offsetIn('Etc/GMT', new Date('2026-07-15T12:00:00Z')), '+00:00');
  assert.equal(offsetIn('Nowhere/Land', new Date()), null);
  assert.equal(offsetAt(-84.2), '-06:00');
  const autumn = { date: '2024-10-21', minutes: 600, offset: '-04:00' };
  assert.deepEqual(onDate(autumn, '2024-12-21', 'America/New_York'), { date: '2024-12-21', minutes: 600, offset: '-05:00' });
  assert.deepEqual(onDate({ ...autumn, offset: '+00:00' }, '2024-12-21', 'America/New_York').offset, '+00:00', 'an offset that was chosen stays');
  assert.deepEqual(onDate(autumn, '2024-12-21', null).offset, '-04:00');
});

test('dates and times are those of the calendar', () => {
  assert.ok(isDate('2024-02-29'));
  for (const text of ['2023-02-29', '2024-04-31', '2024-13-01', 'today', '2024-1-1']) assert.ok(!isDate(text), text);
  assert.equal(parseMoment('2023-02-29T10:00:00Z'), null);
  assert.deepEqual(parseMoment('2024-02-29T23:59:30Z'), { date: '2024-02-29', minutes: 1439, offset: '+00:00' });
});

/** The sun's height at a moment over a place: by the page's own curve, with noon at the meridian by the mean clock. */
function heightAt({ date, minutes, offset }, lon, lat) {
  const season = -23.44 * Math.cos((2 * Math.PI * ((Date.parse(date) - Date.parse(`${date.slice(0, 4)}-01-01`)) / 86_400_000 + 10)) / 365.25);
  const noon = 720 - 4 * lon + 60 * Number(offset.slice(0, 3)) + Number(offset[0] + offset.slice(4));
  return sunAt({ date, offset, lat, noon, noonAltitude: 90 - Math.abs(lat - season), sunrise: null, sunset: null, remark: null }, minutes).altitude;
}

test('a level without a sun of its own opens in the morning of today, under a sun that throws shadows', () => {
  const alps = { bounds: [8, 46.5, 8.4, 46.9], sun: { azimuth: 235, altitude: 18 }, time_zone: 'Europe/Zurich' };
  const summer = openingMoment(alps, new Date('2026-06-21T20:00:00Z'));
  assert.equal(summer.date, '2026-06-21');
  assert.equal(summer.offset, '+02:00');
  // cos H = (sin 18 - sin 46.7 sin 23.44) / (cos 46.7 cos 23.44): the hour angle is 88.2 degrees, 5 h 53 before a noon of 13:29.
  assert.ok(Math.abs(summer.minutes - (7 * 60 + 36)) <= 3, formatMoment(summer));
  const winter = openingMoment(alps, new Date('2026-12-21T20:00:00Z'));
  assert.equal(winter.offset, '+01:00');
  assert.ok(winter.minutes > 9 * 60 && winter.minutes < 12 * 60 + 30, formatMoment(winter));
  for (const [lon, lat, zone] of [[8, 46, 'Europe/Zurich'], [-105, 40, 'America/Denver'], [150, -34, 'Australia/Sydney'], [37, 0, 'Africa/Nairobi'], [20, 69, 'Europe/Oslo'], [-179, 66, null], [179, -45, null]]) {
    for (const month of ['01', '04', '06', '09', '12']) {
      const opened = openingMoment({ bounds: [lon - 0.1, lat - 0.1, lon + 0.1, lat + 0.1], sun: { azimuth: 240, altitude: 15 }, time_zone: zone }, new Date(`2026-${month}-21T12:00:00Z`));
      const height = heightAt(opened, lon, lat);
      assert.ok(height > 4 && height < 21, `${lon} ${lat} ${month}: ${formatMoment(opened)} has the sun ${height.toFixed(1)} high`);
    }
  }
});

test('what the day waits for is told in tiles and pictures', () => {
  const { words, count } = waitText({ minutes: 500, tiles: { done: 3, all: 12 }, ready: 2, all: 71 });
  assert.equal(`${words}: ${count}`, 'Drawing 08:20: 3 of 12 tiles, 2 of 71 pictures of the day');
  assert.equal(waitText({ minutes: 500, tiles: null, ready: 0, all: 71 }).count, '0 of 71 pictures of the day');
});
