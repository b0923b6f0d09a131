import assert from 'node:assert/strict';
import test from 'node:test';

import { load } from './modules.mjs';

const { parseCoordinates } = await load('point/coordinates.ts');

const near = (text, lat, lon) => {
  const found = parseCoordinates(text);
  assert.equal(found?.kind, 'degrees', text);
  assert.ok(Math.abs(found.lat - lat) < 1e-6 && Math.abs(found.lon - lon) < 1e-6, `${text}: ${JSON.stringify(found)}`);
};

test('degrees are read in the usual spellings', () => {
  for (const text of ['47.1, 11.3', '47.1,11.3', ' 47.1  11.3 ', '47.1; 11.3', '47,1; 11,3', '47,1 11,3', '47,1, 11,3', '47.1N 11.3E', '11.3E, 47.1N', 'N 47.1 E 11.3',
    '47.1° N, 11.3° E', "47°06'N 11°18'E", '47°06′N 11°18′E', '47°06′00″N 11°18′00″E', `47° 6' 0" N, 11° 18' 0" E`, 'N47°06.0 E11°18.0', '47 06 00 N 11 18 00 E', '+47.1, +11.3']) {
    near(text, 47.1, 11.3);
  }
  near("36°18'30\"N 84°15'W", 36 + 18.5 / 60, -84.25);
  near('-36.5, -84.25', -36.5, -84.25);
  near('36.5 S 84.25 W', -36.5, -84.25);
  near('−36.5, 84.25', -36.5, 84.25);
});

test('what exceeds degrees is the level’s grid, to the east first', () => {
  assert.deepEqual(parseCoordinates('457000, 5261000'), { kind: 'projected', x: 457000, y: 5261000 });
  assert.deepEqual(parseCoordinates('457000.5 5261000'), { kind: 'projected', x: 457000.5, y: 5261000 });
  assert.deepEqual(parseCoordinates('N 5261000 E 457000'), { kind: 'projected', x: 457000, y: 5261000 });
  assert.deepEqual(parseCoordinates('-9394000, 4343000'), { kind: 'projected', x: -9394000, y: 4343000 });
});

test('what is no place is none', () => {
  for (const text of ['', '47.1', 'Innsbruck', '47.1, 11.3, 5', '47.1 N 11.3 N', "47°61'N 11°18'E", '91°N 11°E', '95 N 190 W', '47.1,', ', 11.3', 'N47.1N, 11', '1e5, 4']) {
    assert.equal(parseCoordinates(text), null, text);
  }
});
