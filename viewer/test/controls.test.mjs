import assert from 'node:assert/strict';
import test from 'node:test';

import { load } from './modules.mjs';

const { share } = await load('share.ts');
const { hoursOf, isRange, rangeFrom, firstOwn } = await load('color_range.ts');
const { pictureQuery } = await load('query.ts');
const { FIRST_STATE } = await load('state.ts');
const { readAddress, writeAddress, addressFaults } = await load('address.ts');
const { filmBody, filmSize, filmTimes } = await load('views/film.ts');
const { isWithin } = await load('point/search.ts');

const SHARED = { title: 'Hills', url: 'https://example.org/#level=hills' };
const clipboard = (copied) => ({ writeText: async (text) => { copied.push(text); } });
const named = (name) => Object.assign(new Error(name), { name });

test('the system’s dialog goes before the clipboard', async () => {
  const [shared, copied] = [[], []];
  assert.equal(await share(SHARED, { share: async (what) => { shared.push(what); }, clipboard: clipboard(copied) }), 'shared');
  assert.deepEqual([shared, copied], [[SHARED], []]);
  assert.equal(await share(SHARED, { share: async () => { throw named('AbortError'); }, clipboard: clipboard(copied) }), 'cancelled');
  assert.deepEqual(copied, []);
  assert.equal(await share(SHARED, { share: async () => { throw named('NotAllowedError'); }, clipboard: clipboard(copied) }), 'copied');
  assert.equal(await share(SHARED, { clipboard: clipboard(copied) }), 'copied');
  assert.deepEqual(copied, [SHARED.url, SHARED.url]);
  assert.equal(await share(SHARED, {}), 'failed');
  assert.equal(await share(SHARED, { clipboard: { writeText: async () => { throw named('NotAllowedError'); } } }), 'failed');
});

test('ranges of colours are those of the service', () => {
  assert.deepEqual(hoursOf('fixed'), [0, 24]);
  assert.deepEqual(hoursOf('6.5,10'), [6.5, 10]);
  for (const text of ['day', '10,6', '0,25', '-1,5', '6', '6,10,12', 'NaN,NaN', '']) assert.equal(hoursOf(text), null, text);
  assert.ok(isRange('day') && !isRange('week'));
  assert.equal(rangeFrom('6', '10.504'), '6,10.5');
  for (const [low, high] of [['', '10'], ['10', '10'], ['a', '3'], ['-1', '3']]) assert.equal(rangeFrom(low, high), null);
  assert.equal(firstOwn({ low: 0, high: 15 }, false), '7,15');
  assert.equal(firstOwn({ low: 360, high: 1080 }, true), '6,18');
});

test('the range is asked for and kept in the address', () => {
  const state = { ...FIRST_STATE, level: 'hills', layer: 'sunhours' };
  assert.equal(pictureQuery(state).color_range, null, 'that of the date is the service’s own');
  assert.equal(pictureQuery({ ...state, range: '6,10' }).color_range, '6,10');
  const written = writeAddress({ ...state, range: '6,10' });
  assert.equal(readAddress(written).range, '6,10');
  assert.deepEqual(addressFaults(written, []), []);
  assert.equal(addressFaults('#range=10,6', []).length, 1);
  assert.equal(readAddress('#range=10,6').range, undefined);
});

test('a film has the frames and no more pixels than services draw', () => {
  assert.deepEqual(filmSize([1280, 1024], 60), [1280, 1024]);
  const [width, height] = filmSize([1280, 1024], 144);
  assert.ok(width * height * 144 <= 2 ** 27 && Math.abs(width / height - 1.25) < 0.01);
  const state = { ...FIRST_STATE, date: '2024-10-21', offset: '-04:00', style: 'swiss', own: { 'plan-filter': '3', 'plan-algorithm': 'sweep', point: '8,47' } };
  const body = filmBody(state, { view: 'ridge' }, [640, 480], [480, 490, 500]);
  assert.deepEqual(body, {
    from: '2024-10-21T08:00:00-04:00', to: '2024-10-21T08:20:00-04:00', step: '10m', fps: 10, size: [640, 480], style: 'swiss', filter: 3, algorithm: 'sweep', view: 'ridge',
  });
  const camera = { eye: [8, 47, 2], target: [8.1, 47, 0], fov: 50 };
  const { path } = filmBody(state, { camera }, [640, 480], [480, 490, 500]);
  assert.deepEqual(path.keys.map(({ at, ...rest }) => rest), [camera, camera]);
  assert.deepEqual(path.keys.map(({ at }) => at), [body.from, body.to]);
});

test('the times of a film go in even steps within the day', () => {
  assert.deepEqual(filmTimes([480, 490, 500, 510], 20), [480, 500]);
  assert.deepEqual(filmTimes([480, 490], 5), [480, 485, 490]);
  assert.deepEqual(filmTimes([480], 10), [480]);
  assert.equal(filmBody(FIRST_STATE, { view: 'ridge' }, [640, 480], filmTimes([480, 490], 5)).step, '5m');
});

test('places of a level lie in its bounds', () => {
  const level = { bounds: [8, 47, 9, 48] };
  assert.ok(isWithin(level, { lng: 8.5, lat: 47.5 }));
  assert.ok(!isWithin(level, { lng: 47.5, lat: 8.5 }));
});
