// Prints version and findings of Khronos' glTF validator for one file, as one line of JSON.
const fs = require('fs'), path = require('path'), validator = require('gltf-validator');
const file = process.argv[2];
const read = uri => Promise.resolve(new Uint8Array(fs.readFileSync(path.join(path.dirname(file), decodeURIComponent(uri)))));
validator.validateBytes(new Uint8Array(fs.readFileSync(file)), {externalResourceFunction: read}).then(report => {
  // Severity 0 is an error and 1 a warning; 2 and 3 are information and hints.
  const findings = report.issues.messages.filter(one => one.severity < 2).map(one => `${one.code} at ${one.pointer || 'the file'}: ${one.message}`);
  console.log(JSON.stringify({version: validator.version(), findings}));
});
