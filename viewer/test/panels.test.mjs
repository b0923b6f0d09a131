import assert from 'node:assert/strict';
import test from 'node:test';

import { load } from './modules.mjs';

const { FIRST_STATE } = await load('state.ts');
const { otherQuery, parseChoice, sideName } = await load('compare/choice.ts');
const { afterKey } = await load('compare/divider.ts');
const { settingsIn } = await load('compare/settings.ts');
const { bearing_deg, parsePosition, positionText, reach_m, viewYaml, wedge } = await load('views/camera.ts');
const { choices, effectsInWords, expectation, isUncalibrated, settingsInWords, withoutFiles } = await load('plan/words.ts');
const { pictureQuery } = await load('query.ts');

const STATE = { ...FIRST_STATE, level: 'hills', date: '2024-10-21', minutes: 17 * 60 + 45, offset: '-04:00', own: { 'plan-filter': '3' } };

test('the other side is the map with one thing changed', () => {
  const own = pictureQuery(STATE);
  assert.equal(own.time, '2024-10-21T17:45:00-04:00');
  assert.equal(own.filter, '3');
  assert.deepEqual(otherQuery(STATE, parseChoice('time:09:30')), { ...own, time: '2024-10-21T09:30:00-04:00' });
  assert.deepEqual(otherQuery(STATE, parseChoice('date:2024-06-21')), { ...own, time: '2024-06-21T17:45:00-04:00' });
  assert.deepEqual(otherQuery(STATE, parseChoice('layer:shadow')), { ...own, layer: 'shadow' });
  assert.deepEqual(otherQuery(STATE, parseChoice('style:swiss')), { ...own, style: 'swiss' });
  assert.deepEqual(otherQuery(STATE, parseChoice('algorithm:sweep')), { ...own, algorithm: 'sweep' });
  assert.equal(sideName(STATE, parseChoice('algorithm:shadow_map'), false), 'shadow map');
  assert.equal(sideName(STATE, parseChoice('algorithm:shadow_map'), true), 'automatic');
  assert.equal(sideName(STATE, parseChoice('filter:sun'), true), 'filter 3');
});

test('what is no choice compares nothing', () => {
  for (const text of [undefined, '', 'time', 'time:', 'time:25:00', 'date:tomorrow', 'layer:mask', ':x']) assert.equal(parseChoice(text), null, text);
});

test('the divider’s keys are those of a slider', () => {
  assert.equal(afterKey('ArrowRight', 0.5), 0.52);
  assert.equal(afterKey('ArrowDown', 0.01), 0);
  assert.equal(afterKey('PageUp', 0.95), 1);
  assert.equal(afterKey('Home', 0.7), 0);
  assert.equal(afterKey('End', 0.7), 1);
  assert.equal(afterKey('a', 0.7), null);
});

test('settings are read off the service’s own interface', () => {
  const parameters = [
    { name: 'level', in: 'path', schema: {} }, { name: 'zoom', in: 'query', schema: {} },
    { name: 'filter', in: 'query', description: 'Taps.', schema: { anyOf: [{ enum: [1, 3, 'sun'] }, { type: 'null' }], examples: [1] } },
    { name: 'map_size', in: 'query', description: 'Texels.', schema: { anyOf: [{ type: 'integer' }, { type: 'null' }], examples: [1024] } },
  ];
  assert.deepEqual(settingsIn({ paths: { '/levels/{level}/plan': { get: { parameters } } } }), [
    { name: 'filter', about: 'Taps.', words: ['1', '3', 'sun'], example: '1' }, { name: 'map_size', about: 'Texels.', words: [], example: '1024' },
  ]);
});

test('a view of one’s own in a level file’s words', () => {
  const camera = { eye: [8.43, 47.5, 1.7], target: [8.43, 47.509, 0], fov: 40 };
  assert.equal(viewYaml(camera, 'valley'), [
    'views:', '  valley:', '    kind: perspective', '    eye: [8.43, 47.5, 1.7]      # longitude, latitude, metres above the ground',
    '    target: [8.43, 47.509, 0]', '    fov: 40', '    size: [1280, 1024]', '',
  ].join('\n'));
  assert.match(viewYaml(camera, 'no'), /^ {2}"no":$/m);
  assert.match(viewYaml(camera, 'a: b'), /^ {2}"a: b":$/m);
  assert.ok(Math.abs(reach_m(camera) - 1000.8) < 1);
  assert.equal(Math.round(bearing_deg(camera)), 0);
  assert.deepEqual(parsePosition(positionText(camera.eye)), [8.43, 47.5, 1.7]);
  for (const text of [undefined, '', '1,2', '1,2,x', '1,95,0', '1,2,3,4']) assert.equal(parsePosition(text), null, text);
  const outline = wedge(camera);
  assert.deepEqual(outline[0], outline.at(-1));
  // Half the width of a picture of 1280 x 1024 pixels, 40 degrees high, is 24.5 degrees.
  const angle = (Math.atan2((outline[1][0] - 8.43) * Math.cos((47.5 * Math.PI) / 180), outline[1][1] - 47.5) * 180) / Math.PI;
  assert.ok(Math.abs(angle + 24.46) < 0.1, String(angle));
});

test('a plan in plain words', () => {
  const reasons = [
    { name: 'sun/relief: sweep', reason: 'relief is a heightfield' }, { name: 'map_size 4096', reason: 'a texel covers 0.35 pixels' },
    { name: 'policy rules', reason: 'this device is not calibrated' },
  ];
  assert.deepEqual(choices({ algorithm: { sun: { relief: 'sweep' }, lamp: { relief: 'none' } }, reasons }), [
    { name: 'Relief by sweep', reason: 'Relief is a heightfield.' }, { name: 'Relief under lamp casts nothing', reason: '' },
  ]);
  assert.deepEqual(settingsInWords({ reasons }), [{ name: 'Map size 4096', reason: 'A texel covers 0.35 pixels.' }]);
  assert.deepEqual(effectsInWords([{ name: 'snow', reason: 'none' }, { name: 'clouds', reason: 'none' }, { name: 'new_thing', reason: '' }]), [
    { name: 'Snow, clouds', reason: 'None.' }, { name: 'New thing', reason: '' },
  ]);
  const target = { max_error: 0.03, max_ms: 200, met: false };
  assert.match(expectation({ policy: 'rules', predicted: null, target, reasons }), /^This device is not calibrated\. Time and error are not predicted/);
  assert.match(expectation({ policy: 'predict', predicted: { ms: 1500, wrong_cast: 0.05 }, target, reasons }), /1\.5 s .* misses the target .* by 2 % of the cast shadow and 1\.3 s\.$/);
});

test('reasons cite no files, which nobody can follow from a page', () => {
  const swept = 'relief is a heightfield (docs/reports/sweep-accuracy.md: 0.01 % wrong in maps; docs/selection.md: 0.25 % where views draw fewer triangles)';
  assert.equal(withoutFiles(swept), 'relief is a heightfield (0.01 % wrong in maps; 0.25 % where views draw fewer triangles)');
  assert.equal(withoutFiles('leaves need a map (Sindholt 2005, table 1; docs/reports/seeds.md, the advice)'), 'leaves need a map (Sindholt 2005, table 1)');
  assert.equal(withoutFiles('settings of a map (docs/algorithms.md)'), 'settings of a map');
  assert.equal(withoutFiles('840 m of relief (also outside)'), '840 m of relief (also outside)');
  const [{ reason }] = choices({ algorithm: { sun: { relief: 'sweep' } }, reasons: [{ name: 'sun/relief: sweep', reason: swept }] });
  assert.doesNotMatch(reason, /docs/);
});

test('a device that the service measures itself is not to be calibrated by hand', () => {
  const reason = 'this device is not calibrated, so fixed rules choose (to get predictions, run skugga calibrate)';
  const plan = { policy: 'rules', predicted: null, target: { max_error: 0.03, max_ms: null, met: null }, reasons: [{ name: 'policy rules', reason }] };
  assert.ok(isUncalibrated(plan));
  for (const state of ['waiting', 'running', 'paused', 'calibrated', 'failed']) {
    assert.match(expectation(plan, state), /^This device is not calibrated, so fixed rules choose\. The service /, state);
    assert.doesNotMatch(expectation(plan, state), /skugga calibrate/, state);
  }
  for (const state of ['off', 'none', null]) assert.match(expectation(plan, state), /run skugga calibrate/, String(state));
  assert.ok(!isUncalibrated({ reasons: [{ name: 'policy rules', reason: 'asked for' }] }));
});
