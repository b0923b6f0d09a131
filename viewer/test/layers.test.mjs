// The layers that a level offers: known ones in their order, then products with a legend.

import assert from 'node:assert/strict';
import test from 'node:test';

import { load } from './modules.mjs';

const { hasLegend, layersOf } = await load('layers.ts');

const product = (name, when, legend) => ({ name, about: `about ${name}`, when, legend });
const LEVEL = {
  map_layers: ['color', 'shadow', 'mask', 'slope', 'sunhours', 'yearly'],
  products: [
    product('color', 'sun', false), product('mask', 'sun', false), product('slope', 'none', true), product('sunhours', 'days', true),
    product('yearly', 'days', true),
  ],
};

test('a product with a legend is listed after the known layers', () => {
  assert.deepEqual(layersOf(LEVEL).map(({ name }) => name), ['color', 'shadow', 'sunhours', 'slope']);
  assert.deepEqual(layersOf(LEVEL).at(-1), { name: 'slope', label: 'Slope', about: 'About slope' });
});

test('what a level does not have is not listed', () => {
  assert.deepEqual(layersOf({ ...LEVEL, map_layers: ['color'], products: undefined }).map(({ name }) => name), ['color']);
});

test('a legend is of colours that stand for numbers', () => {
  assert.deepEqual(['color', 'mask', 'slope', 'sunhours'].map((name) => hasLegend(LEVEL, name)), [false, false, true, true]);
});
