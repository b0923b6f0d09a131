/** The map: one raster layer of the service on a plain ground. */

import { AttributionControl, Map, NavigationControl, ScaleControl, addProtocol, setWorkerUrl } from 'maplibre-gl';
import workerUrl from 'maplibre-gl/dist/maplibre-gl-worker.mjs?worker&url';
import 'maplibre-gl/dist/maplibre-gl.css';

import { request } from './service.js';

setWorkerUrl(workerUrl);

const SOURCE = 'level';
const SCHEME = 'tile://';
const GROUND = '#efece4';
const TILE_SIZE = 256;
// On a dense screen each tile covers fewer CSS pixels: the next zoom is drawn, one tile pixel to one screen pixel.
const DENSITY = window.devicePixelRatio > 1.4 ? 2 : 1;

/**
 * Makes the map in an element.
 * `onProgress({loading, failed, message})` is told how many tiles are on their way, how many failed since `show`, and why the last did.
 * Throws if the browser cannot draw it.
 */
export function createMap(container, onProgress) {
  const progress = { loading: 0, failed: 0, message: '' };
  const tell = () => onProgress({ ...progress });

  // MapLibre's own loading keeps 404s to itself, gives no Retry-After and says "AJAXError"; hence a loader of our own.
  addProtocol('tile', async ({ url }, controller) => {
    progress.loading += 1;
    tell();
    try {
      const response = await request(url.slice(SCHEME.length), controller.signal);
      return { data: await response.arrayBuffer() };
    } catch (error) {
      if (error.name !== 'AbortError') {
        progress.failed += 1;
        progress.message = error.message;
      }
      throw error;
    } finally {
      progress.loading -= 1;
      tell();
    }
  });

  const map = new Map({
    container,
    style: { version: 8, sources: {}, layers: [{ id: 'ground', type: 'background', paint: { 'background-color': GROUND } }] },
    attributionControl: false,
    dragRotate: false,
    pitchWithRotate: false,
    touchPitch: false,
    maxPitch: 0,
    renderWorldCopies: false,
  });
  map.touchZoomRotate.disableRotation();
  map.keyboard.disableRotation();
  // From the bottom up.
  map.addControl(new AttributionControl({ compact: false }), 'bottom-right');
  map.addControl(new ScaleControl({ maxWidth: 120 }), 'bottom-right');
  map.addControl(new NavigationControl({ showCompass: false }), 'bottom-right');
  // Failed tiles have been told by the loader; the listener keeps MapLibre from telling them to the console again.
  map.on('error', () => {});

  let shown = null;

  /** Shows the tiles of a TileJSON document; the ones on screen stay until the new ones are there, unless `key` has changed. */
  function show(key, tilejson) {
    progress.failed = 0;
    progress.message = '';
    tell();
    const tiles = tilejson.tiles.map((tile) => SCHEME + tile);
    if (shown === key) {
      map.getSource(SOURCE).setTiles(tiles);
      return;
    }
    if (shown !== null) {
      map.removeLayer(SOURCE);
      map.removeSource(SOURCE);
    }
    shown = key;
    map.addSource(SOURCE, {
      type: 'raster',
      tiles,
      tileSize: TILE_SIZE / DENSITY,
      bounds: tilejson.bounds,
      minzoom: tilejson.minzoom,
      maxzoom: tilejson.maxzoom,
      attribution: tilejson.attribution,
    });
    map.addLayer({ id: SOURCE, type: 'raster', source: SOURCE, paint: { 'raster-fade-duration': 150 } });
    // MapLibre counts zooms for tiles of 512. Further out than the first zoom there is nothing to see; further in
    // than two past the last, only blur.
    map.setMinZoom(Math.max(0, tilejson.minzoom - Math.log2((512 * DENSITY) / TILE_SIZE)));
    map.setMaxZoom(tilejson.maxzoom + 2);
  }

  /** The zoom of the tiles on screen, within those that there are. */
  function tileZoom(zooms) {
    const zoom = Math.round(map.getZoom() + Math.log2((512 * DENSITY) / TILE_SIZE));
    return Math.min(Math.max(zoom, zooms.minzoom), zooms.maxzoom);
  }

  return { map, show, tileZoom };
}
