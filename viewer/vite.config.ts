import { defineConfig } from 'vite';

export default defineConfig({
  // Relative addresses, so that the page works behind any path prefix.
  base: './',
  build: {
    outDir: '../api/static',
    emptyOutDir: true,
    // MapLibre alone is larger than the default warning.
    chunkSizeWarningLimit: 2000,
    // The licences of what is bundled travel with it.
    license: { fileName: 'licenses.md' },
    rollupOptions: {
      output: {
        // MapLibre apart: it stays in browsers' caches when the viewer changes, and the viewer's own size can be read off.
        manualChunks: (id: string) => (id.includes('maplibre-gl') ? 'maplibre' : undefined),
      },
    },
  },
  // `npm run dev` beside a running service.
  server: { proxy: Object.fromEntries(['/levels', '/readyz', '/openapi.json'].map((path) => [path, 'http://127.0.0.1:8000'])) },
});
